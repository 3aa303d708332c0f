"""A mesh that can be turned with the mouse, in a notebook or a file of its own."""

import base64
import html
import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxdeform._checks import check_count, read_path
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.writing import check_place, write_atomically
from jaxdeform._plotting.arguments import Paint, read_look, read_poses
from jaxdeform._plotting.camera import View
from jaxdeform._plotting.files import check_can_draw, png
from jaxdeform._plotting.render import panel_height, set_up, sheet_of
from jaxdeform._plotting.scene import FIXED, MOVED, Dots, Stage, in_view
from jaxdeform._plotting.surface import Surface
from jaxdeform._plotting.texture import seen_at_vertices

# Half of what the eye takes in from top to bottom. A small angle looks like the parallel pictures.
_HALF_ANGLE = 10.0

# There and back again, a second from pose to pose.
_PLAY = """
const last = %d, began = performance.now();
setInterval(() => {
  const seconds = ((performance.now() - began) / 1000) %% (2 * last);
  K3DInstance.setTime(Math.min(seconds, 2 * last - seconds));
}, 40);
"""


@dataclass(frozen=True, repr=False)
class Turnable:
    """A mesh to be turned, which notebooks show as `show` says.

    **Fields**

    - html: a whole page, which needs nothing from elsewhere.
    - png: the same as a picture.
    - width, height: of the part of the picture that turns, in pixels.
    """

    html: str
    png: bytes
    width: int
    height: int

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page into a ``.html`` file; replaced as a whole or not at all.

        **Raises** InputError: the name does not end in .html; the folder cannot be written.
        """
        path = read_path("path", path)
        if path.suffix.lower() != ".html":
            raise InputError(f"{path}: pages are HTML files: use a .html name")
        check_place(path)
        write_atomically(path, self.html.encode())

    def _repr_png_(self) -> bytes:
        return self.png

    def _repr_html_(self) -> str:
        """Return the picture, and over it the page: an untrusted notebook takes the page out."""
        picture = base64.b64encode(self.png).decode()
        return (
            '<div style="position:relative;display:inline-block">'
            f'<img src="data:image/png;base64,{picture}">'
            f'<iframe srcdoc="{html.escape(self.html)}" style="position:absolute;left:0;top:0;'
            f'width:{self.width}px;height:{self.height}px;border:0"></iframe></div>'
        )


def show(
    mesh: Mesh,
    poses: Sequence[ArrayLike] | ArrayLike | None = None,
    *,
    values: Sequence[ArrayLike | None] | str = (),
    label: str = "",
    handles: ArrayLike | None = None,
    moved: ArrayLike | None = None,
    up: str | ArrayLike | None = None,
    width: int = 500,
) -> Turnable:
    """Return a mesh that a notebook shows, and that the mouse turns, moves and zooms.

    A notebook that is not trusted shows a picture instead. Several poses are played there and back
    again, the vertices moving along straight lines from one to the next; the picture has the first.
    An image on the surface is shown by the colours that it has at the vertices. For a file to look
    at elsewhere: ``show(...).save("m.html")``.

    **Arguments**

    - mesh: gives the faces.
    - poses: a list of positions (vertices, 3), or an array (poses, vertices, 3). By default the
      rest shape.
    - values, label, handles, moved, up: as in `render`.
    - width: in pixels, from 100 to 2,000.

    **Raises** InputError: pyvista or k3d is not installed; no poses, or of another shape than the
    mesh, or not finite; values that are not finite.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> mesh = jd.shapes.square()
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "square.html"
        >>> jd.show(mesh, handles=jd.select.border(mesh)).save(path)
        >>> path.stat().st_size > 100_000
        True
    """
    check_can_draw()
    if find_spec("k3d") is None:
        raise InputError("turning needs k3d: pip install 'jaxdeform[viewer]'")
    check_count("width", width, least=100, most=2000)
    look = read_look(mesh, handles, moved, up, edges=False)
    arrays = read_poses(mesh, [mesh.vertices] if poses is None else poses)
    for k, pose in enumerate(arrays):
        if not np.isfinite(pose).all():
            vertex = int(np.flatnonzero(~np.isfinite(pose).all(axis=1))[0])
            raise InputError(f"poses[{k}]: vertex {vertex} is not finite: leave this pose out")
    surface, _, paint, (view,), dots = set_up(look, arrays, values, label)
    height = panel_height(width, view)
    with closing(Stage(surface, width, height, edges=False)) as stage:
        panel = stage.draw(arrays[0], paint.coats[0], view, dots)
    picture = png(sheet_of(width, height, paint, dots).arrange([panel], [[]], columns=1))
    return Turnable(_page(surface, arrays, paint, view, dots), picture, width, height)


def _page(surface: Surface, poses, paint: Paint, view: View, dots: Dots | None) -> str:
    """Return a page that shows the poses, one a second."""
    import k3d  # slow to import, and needed only here
    from ipywidgets import Widget  # comes with k3d

    textured = [coat.colors for coat in paint.coats if coat.textured]  # all alike
    own = [seen_at_vertices(surface.mesh, surface.textures, plain) for plain in textured[:1]]
    colors = [own[0] if coat.textured else coat.colors for coat in paint.coats]
    near = [in_view(pose, view) for pose in poses]
    plot: Any = k3d.factory.plot(
        grid_visible=False,
        menu_visibility=False,
        camera_auto_fit=False,
        camera_fov=2 * _HALF_ANGLE,
        axes_helper=0,
        colorbar_object_id=0,
        background_color=0xFFFFFF,
        lighting=1.8,
        additional_js_code=_PLAY % (len(poses) - 1) if len(poses) > 1 else "",
    )
    plot += k3d.mesh(
        _over_time([pose[surface.index] for pose in near]),
        surface.faces.astype(np.uint32),
        normals=_over_time([surface.normals(pose) for pose in near]),
        colors=_over_time([_packed(color[surface.index]) for color in colors], np.uint32),
        flat_shading=False,
        side="double",
    )
    for kind, color in ((False, FIXED), (True, MOVED)):
        if dots is not None and (dots.moved == kind).any():
            chosen = dots.vertices[dots.moved == kind]
            plot += k3d.points(
                _over_time([pose[chosen] for pose in near]),
                color=int(color[1:], 16),
                point_size=0.012,
            )
    away = max(view.half_height, view.half_width) / view.depth / np.tan(np.radians(_HALF_ANGLE))
    plot.camera = [*(away * view.toward), 0.0, 0.0, 0.0, *view.above]
    page = plot.get_snapshot()
    for widget in (*plot.objects, plot.layout, plot):  # else their arrays stay in the process
        Widget.close(widget)
    return page


def _over_time(arrays: list[Any], dtype: Any = np.float32) -> Any:
    """Return one array, or one for each second."""
    typed = [np.asarray(array, dtype) for array in arrays]
    return typed[0] if len(typed) == 1 else {str(k): array for k, array in enumerate(typed)}


def _packed(colors: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """Return each colour as one number, 0xRRGGBB."""
    return np.rint(255 * colors).astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
