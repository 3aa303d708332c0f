"""Pictures of meshes, drawn without a display. They need the extra ``viewer``."""

import os
from collections.abc import Sequence
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_count, check_type, read_host_positions, read_path
from jaxdeform._errors import ArrayLike, InputError, a_or_an
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.writing import check_place, write_atomically

# Where the CPU draws, 40 million pixels take 3 GB; 16,384 is the width that graphics systems allow.
_MOST_PIXELS, _MOST_WIDTH = 40e6, 16384
# The frames of an animation are in memory together, 1 MB each.
_MOST_FRAMES = 200


def render(
    path: str | os.PathLike,
    mesh: Mesh,
    poses: Sequence[ArrayLike],
    *,
    titles: Sequence[str] = (),
    values: Sequence[ArrayLike | None] = (),
    label: str = "rigidity",
    width: int = 500,
) -> None:
    """Draw poses of a mesh side by side, all at the same scale, into a PNG file.

    **Arguments**

    - path: a ``.png`` file; replaced as a whole or not at all.
    - mesh: gives the faces.
    - poses: a list of positions (vertices, 3).
    - titles: one text per pose.
    - values: for each pose an array (vertices,), a number, or None; shown as colour, on a
      logarithmic scale if all are positive and they differ by more than a factor of 5.
    - label: the name of the values.
    - width: the width of each view, in pixels, from 16. Its height is 1.3 times that. The picture
      may have 40 million pixels and be 16,384 wide.

    **Raises** InputError: the name does not end in .png; the folder cannot be written; pyvista is
    not installed; no poses, or of another shape than the mesh; values that are not finite.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> mesh = jd.shapes.square()
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "square.png"
        >>> jd.render(path, mesh, [mesh.vertices])
        >>> path.stat().st_size > 1000
        True
    """
    path = read_path("path", path)
    check_type("mesh", mesh, Mesh)
    arrays = _read_poses(mesh, poses)
    colors = _read_values(mesh, values, len(arrays))
    _check_texts(titles, label, len(arrays))
    most = min((_MOST_PIXELS / 1.3 / len(arrays)) ** 0.5, _MOST_WIDTH / len(arrays))
    check_count("width", width, least=16, most=int(most))
    check_picture_path(path)
    plotter = _plotter(len(arrays), width)
    scale = _color_scale([v for v in colors if v is not None], label)
    for k, pose in enumerate(arrays):
        plotter.subplot(0, k)
        _add_surface(plotter, mesh, pose, colors[k], scale)
        if k < len(titles):
            plotter.add_text(titles[k], font_size=10)
    plotter.link_views()
    _look_at(plotter, arrays)
    image = np.asarray(plotter.screenshot(return_img=True))
    plotter.close()
    write_atomically(path, _png(image))


def animate(
    path: Path,
    mesh: Mesh,
    poses: Sequence[ArrayLike] | np.ndarray,
    *,
    values: ArrayLike | None = None,
) -> None:
    """Draw poses one after the other into an animated GIF, which takes four seconds and repeats.

    Of very many poses it shows some, evenly chosen, with the last. **Raises** InputError as
    `render`.
    """
    arrays = _read_poses(mesh, poses)
    (color,) = _read_values(mesh, [values], 1)
    check_picture_path(path, ".gif")
    chosen = np.linspace(len(arrays) - 1, 0, min(len(arrays), _MOST_FRAMES)).round().astype(int)
    arrays = [arrays[k] for k in chosen[::-1]]
    plotter = _plotter(1, 500)
    scale = _color_scale([] if color is None else [color], "rigidity")
    surface = _add_surface(plotter, mesh, arrays[0], color, scale)
    _look_at(plotter, arrays)
    images = []
    for pose in arrays:
        surface.points = pose
        plotter.render()
        images.append(np.asarray(plotter.screenshot(return_img=True)))
    plotter.close()
    write_atomically(path, _gif(images))


def _plotter(views: int, width: int) -> Any:
    import pyvista  # slow to import, and needed only here
    from vtkmodules.vtkCommonCore import vtkLogger

    # Without a display VTK falls back to drawing in memory, which is what we want: no warning.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    size = [width * views, int(1.3 * width)]
    return pyvista.Plotter(shape=(1, views), window_size=size, off_screen=True)


def _add_surface(plotter: Any, mesh: Mesh, pose: np.ndarray, color, scale: dict[str, Any]) -> Any:
    """Add a surface to the view, in one colour if it has no values; return it."""
    import pyvista

    surface = pyvista.PolyData.from_regular_faces(pose, mesh.faces)
    options = {"color": "lightsteelblue"} if color is None else {"scalars": color, **scale}
    plotter.add_mesh(surface, show_edges=mesh.n_faces < 5000, line_width=0.5, **options)
    return surface


def _look_at(plotter: Any, poses: list[np.ndarray]) -> None:
    """Look along the direction in which all poses together are thinnest."""
    together = np.concatenate(poses)
    plotter.camera_position = _camera(together)
    plotter.reset_camera(bounds=_bounds(together))


def _read_poses(mesh: Mesh, poses: Any) -> list[np.ndarray]:
    poses = _listed("poses", poses, "positions (vertices, 3)")
    if not poses:
        raise InputError("poses is empty: give at least one, such as [mesh.vertices]")
    shape = mesh.vertices.shape
    return [read_host_positions(f"poses[{k}]", pose, shape) for k, pose in enumerate(poses)]


def _read_values(mesh: Mesh, values: Any, count: int) -> list[np.ndarray | None]:
    """Return one array (vertices,) or None per pose."""
    values = _listed("values", values, "arrays, numbers or None, one per pose")
    if len(values) > count:
        raise InputError(f"values has {len(values)} entries for {count} poses: give one per pose")
    out: list[np.ndarray | None] = [None] * count
    for k, value in enumerate(values):
        if value is not None:
            name, n = f"values[{k}]", mesh.n_vertices
            given = read_host_array(value, np.float64, name)
            if given.shape not in ((), (n,)) or not np.isfinite(given).all():
                raise InputError(
                    f"{name} has shape {given.shape}: give None, a finite number or ({n},) of them"
                )
            out[k] = np.broadcast_to(given, n)
    return out


def _listed(name: str, value: Any, of: str) -> list:
    """Return the entries of a list or an array; text is a list of letters, a dict of keys."""
    array = isinstance(value, np.ndarray | jax.Array) and value.ndim > 0
    if not array and not isinstance(value, list | tuple):
        raise InputError(f"{name} is {a_or_an(value)}: give a list of {of}")
    return list(value)


def _check_texts(titles: Any, label: Any, count: int) -> None:
    titles = _listed("titles", titles, "texts, one per pose")
    if len(titles) > count:
        raise InputError(f"titles has {len(titles)} entries for {count} poses: give one per pose")
    for name, text in [("label", label), *((f"titles[{k}]", t) for k, t in enumerate(titles))]:
        if not isinstance(text, str):
            raise InputError(f"{name} is {a_or_an(text)}: give a text")


def _color_scale(shown: Sequence[ArrayLike], label: str) -> dict[str, Any]:
    """Return the options of pyvista that all poses share, so that colours can be compared."""
    low, high = (min(map(np.min, shown)), max(map(np.max, shown))) if shown else (0.0, 1.0)
    return {
        "clim": (low, high) if high > low else (low, low + 1),
        "log_scale": bool(low > 0 and high > 5 * low),
        "cmap": "viridis",
        "scalar_bar_args": {"title": label},
    }


def _png(image: np.ndarray) -> bytes:
    from PIL import Image  # comes with pyvista

    content = BytesIO()
    Image.fromarray(image).save(content, format="PNG")
    return content.getvalue()


def _gif(images: list[np.ndarray]) -> bytes:
    from PIL import Image  # comes with pyvista, which needs one more package for GIFs

    content = BytesIO()
    first, *others = (Image.fromarray(image).quantize(128) for image in images)
    milliseconds = max(20, round(4000 / len(images)))
    first.save(
        content,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=milliseconds,
        loop=0,
    )
    return content.getvalue()


def check_picture_path(path: Path, suffix: str = ".png") -> None:
    """Raise InputError if no picture can be written at this path."""
    if path.suffix.lower() != suffix:
        raise InputError(f"{path}: pictures are PNG files: use a .png name")
    if find_spec("pyvista") is None:
        raise InputError("pictures need pyvista: pip install 'jaxdeform[viewer]'")
    check_place(path)


def _camera(points: Float[np.ndarray, "points 3"]):
    extent = np.ptp(points, axis=0)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    thin, up = int(np.argmin(extent)), int(np.argmax(extent))
    if extent[1] > 0.8 * extent[up] and thin != 1:
        up = 1  # most meshes stand upright along y
    direction = np.full(3, 0.35)
    direction[thin], direction[up] = 1.0, 0.25
    return [middle + 3 * np.linalg.norm(extent) * direction, middle, np.eye(3)[up]]


def _bounds(points: Float[np.ndarray, "points 3"]) -> list[float]:
    low, high = points.min(axis=0), points.max(axis=0)
    return [value for pair in zip(low, high, strict=True) for value in pair]
