"""Pictures of meshes, drawn without a display. They need the extra ``viewer``."""

import os
from collections.abc import Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from jaxdeform._checks import check_count, read_path
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._plotting.arguments import (
    Fault,
    Look,
    Paint,
    Pose,
    find_faults,
    listed,
    read_look,
    read_paint,
    read_poses,
    read_texts,
)
from jaxdeform._plotting.camera import View, find_view
from jaxdeform._plotting.files import Picture, check_picture_path, write_png
from jaxdeform._plotting.scene import Dots, Stage
from jaxdeform._plotting.sheet import Legend, Sheet, Text
from jaxdeform._plotting.surface import Surface

# Where the CPU draws, 40 million pixels take 3 GB; 16,384 is the width that graphics systems allow.
_MOST_PIXELS, _MOST_WIDTH = 40e6, 16384
# A panel is at least and at most this many times as high as wide.
FLATTEST, TALLEST = 0.5, 1.5
# So many panels stand side by side, unless columns are given.
_MOST_COLUMNS = 5


def render(
    path: str | os.PathLike[str],
    mesh: Mesh,
    poses: Sequence[ArrayLike] | ArrayLike,
    *,
    titles: Sequence[str] = (),
    values: Sequence[ArrayLike | None] | str = (),
    label: str = "",
    handles: ArrayLike | None = None,
    moved: ArrayLike | None = None,
    up: str | ArrayLike | None = None,
    columns: int | None = None,
    edges: bool = False,
    width: int = 500,
) -> None:
    """Draw poses of a mesh beside each other, with one camera, light and scale, into a PNG file.

    A pose that is not finite, or that reaches 5 times as far as the others, does not hide them: it
    is cut off, and its title says so. Without values a mesh has the images or colours of its file,
    if the file names or has any.

    **Arguments**

    - path: a ``.png`` file; replaced as a whole or not at all.
    - mesh: gives the faces.
    - poses: a list of positions (vertices, 3).
    - titles: one text per pose.
    - values: for each pose an array (vertices,), a number, or None; shown as colour, on a
      logarithmic scale if all are positive and they differ by more than a factor of 5. Or the text
      ``"stretch"``: how many times longer the surface has become in the direction of most stretch.
    - label: the name of the values. By default ``rigidity``, or ``stretch``.
    - handles: vertices to mark by dots: indices, a mask or a `Selection`.
    - moved: those of them that move. By default, those that some pose moves.
    - up: ``"x"``, ``"y"``, ``"z"`` or a direction (3,). By default, the side on which the mesh
      would stand, or else its longest axis.
    - columns: how many panels stand side by side. By default up to 5.
    - edges: also draw the edges of the triangles.
    - width: the width of each panel, in pixels, from 16. The picture may have 40 million pixels and
      be 16,384 wide.

    **Raises** InputError: the name does not end in .png; the folder cannot be written; pyvista is
    not installed; no poses, or of another shape than the mesh; values that are not finite.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> mesh = jd.shapes.square()
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "square.png"
        >>> jd.render(path, mesh, [mesh.vertices], handles=jd.select.border(mesh))
        >>> path.stat().st_size > 1000
        True
    """
    path = read_path("path", path)
    check_picture_path(path)
    look = read_look(mesh, handles, moved, up, edges)
    arrays = read_poses(mesh, poses)
    texts = read_texts("titles", titles, len(arrays))
    if columns is None:
        rows = -(-len(arrays) // _MOST_COLUMNS)
        columns = -(-len(arrays) // rows)
    columns = min(check_count("columns", columns), len(arrays))
    image = _drawn(look, arrays, _Grid(columns, texts), values, label, width)
    write_png(path, image)


def render_grid(
    path: str | os.PathLike[str],
    mesh: Mesh,
    poses: Sequence[Sequence[ArrayLike]] | ArrayLike,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    values: Sequence[Sequence[ArrayLike | None]] | str = (),
    label: str = "",
    handles: ArrayLike | None = None,
    moved: ArrayLike | None = None,
    up: str | ArrayLike | None = None,
    edges: bool = False,
    width: int = 300,
) -> None:
    """Draw poses that depend on two things as a grid, as in thesis Fig. 5.3, into a PNG file.

    **Arguments**

    - path, mesh, label, handles, moved, up, edges, width: as in `render`.
    - poses: for each row a list with a pose (vertices, 3) for each column; or an array (rows,
      columns, vertices, 3), as two nested vmaps return it.
    - rows: one text per row, such as ``"r = 2"``; it stands on the left.
    - columns: one text per column, such as ``"λ = 0.1"``; it stands on top.
    - values: for each row a list with an array (vertices,), a number or None for each column; or
      the text ``"stretch"``.

    **Raises** InputError as `render`, and if a row has more or fewer poses than there are columns.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> mesh = jd.shapes.square()
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "grid.png"
        >>> poses = [[jd.bend(mesh.vertices, a), jd.twist(mesh.vertices, a)] for a in (20, 40)]
        >>> jd.render_grid(path, mesh, poses, ["20°", "40°"], ["bend", "twist"], width=100)
        >>> path.stat().st_size > 1000
        True
    """
    path = read_path("path", path)
    check_picture_path(path)
    look = read_look(mesh, handles, moved, up, edges)
    down, across = read_texts("rows", rows, 1000), read_texts("columns", columns, 1000)
    for name, labels in (("rows", down), ("columns", across)):
        if not labels:
            raise InputError(f"{name} is empty: give one text for each")
    arrays = [
        pose
        for r, row in enumerate(_table("poses", poses, len(down)))
        for pose in _row(f"poses[{r}]", read_poses(mesh, row, f"poses[{r}]"), len(across))
    ]
    if not isinstance(values, str) and len(listed("values", values, "rows")):
        values = [
            value
            for r, row in enumerate(_table("values", values, len(down)))
            for value in _row(f"values[{r}]", row, len(across))
        ]
    grid = _Grid(len(across), (), down, across)
    image = _drawn(look, arrays, grid, values, label, width)
    write_png(path, image)


def _table(name: str, value: Any, rows: int) -> list[Any]:
    given = listed(name, value, "rows")
    if len(given) != rows:
        raise InputError(f"{name} has {len(given)} rows, but rows has {rows} texts: give as many")
    return given


def _row(name: str, value: Any, columns: int) -> list[Any]:
    given = listed(name, value, "one entry per column")
    if len(given) != columns:
        raise InputError(
            f"{name} has {len(given)} entries, but columns has {columns} texts: give as many"
        )
    return given


class _Grid(NamedTuple):
    """Where the panels stand, and what is written around them."""

    columns: int
    titles: Sequence[str] = ()
    row_labels: Sequence[str] = ()
    column_labels: Sequence[str] = ()


def _drawn(
    look: Look, poses: list[Pose], grid: _Grid, values: Any, label: Any, width: Any
) -> Picture:
    """Return the picture of all poses."""
    surface, faults, paint, (view,), dots = set_up(look, poses, values, label)
    panels = -(-len(poses) // grid.columns) * grid.columns
    most = min((_MOST_PIXELS / TALLEST / panels) ** 0.5, _MOST_WIDTH / grid.columns)
    check_count("width", width, least=16, most=int(most))
    height = panel_height(width, view)
    with closing(Stage(surface, width, height, edges=look.edges)) as stage:
        drawn = [
            stage.draw(pose, coat, view, dots)
            for pose, coat in zip(poses, paint.coats, strict=True)
        ]
    titles = [
        [Text(words) for words in grid.titles[k : k + 1]]
        + [Text(fault.words, warns=True)] * bool(fault.words)
        for k, fault in enumerate(faults)
    ]
    sheet = sheet_of(width, height, paint, dots)
    return sheet.arrange(drawn, titles, grid.columns, grid.row_labels, grid.column_labels)


class Setting(NamedTuple):
    """What is drawn, and from where."""

    surface: Surface
    faults: list[Fault]
    paint: Paint
    views: list[View]
    dots: Dots | None


def set_up(
    look: Look, poses: list[Pose], values: Any, label: Any, turns: np.ndarray | None = None
) -> Setting:
    """Read what the poses are painted with, and find views that show them, one for each turn."""
    surface = Surface(look.mesh)
    faults = find_faults(look.mesh, poses)
    paint = read_paint(surface, poses, faults, values, label)
    framed = _framing(look.mesh, poses, faults)
    views = find_view(framed, look.up, np.zeros(1) if turns is None else turns)
    dots = look.dots([pose for pose, fault in zip(poses, faults, strict=True) if fault.frames])
    return Setting(surface, faults, paint, views, dots)


def _framing(mesh: Mesh, poses: list[Pose], faults: list[Fault]) -> list[np.ndarray]:
    """Return the poses that the picture is made large enough for; without one, the rest shape."""
    framed = [
        pose[np.isfinite(pose).all(axis=1)] if fault.words else pose
        for pose, fault in zip(poses, faults, strict=True)
        if fault.frames
    ]
    return framed or [mesh.vertices]


def panel_height(width: int, view: View) -> int:
    """Return the height of a panel that the view fills, within limits."""
    ratio = np.clip(view.half_height / view.half_width, FLATTEST, TALLEST)
    return max(8, round(width * float(ratio)))


def sheet_of(width: int, height: int, paint: Paint, dots: Dots | None) -> Sheet:
    """Return a sheet for panels of this size, with the legend of what is on them."""
    moved = np.zeros(0, bool) if dots is None else dots.moved
    kinds = {"fixed": ~moved, "moved": moved}
    shown = tuple(name for name, some in kinds.items() if some.any())
    return Sheet(width, height, Legend(paint.scale, paint.label, shown))
