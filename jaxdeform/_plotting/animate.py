"""Films of meshes: a path of poses, or a walk around one."""

import os
from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_count, check_tolerance, read_path
from jaxdeform._errors import ArrayLike, InputError, shown
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._plotting.arguments import read_look, read_poses, read_value
from jaxdeform._plotting.files import check_picture_path, write_film
from jaxdeform._plotting.render import panel_height, set_up, sheet_of
from jaxdeform._plotting.scene import Stage
from jaxdeform._plotting.sheet import Text

# All frames are in memory together.
_MOST_FRAMES, _MOST_PIXELS = 240, 200e6
# A turn of one pose takes a frame for so many degrees.
_STEP = 6.0


def animate(
    path: str | os.PathLike[str],
    mesh: Mesh,
    poses: Sequence[ArrayLike] | ArrayLike,
    *,
    values: ArrayLike | str | None = None,
    label: str = "",
    handles: ArrayLike | None = None,
    moved: ArrayLike | None = None,
    up: str | ArrayLike | None = None,
    turn: float = 0.0,
    seconds: float = 4.0,
    edges: bool = False,
    width: int = 500,
) -> None:
    """Draw poses one after the other into a GIF, which repeats, or an MP4 file.

    For a film that goes there and back: ``[*poses, *poses[::-1]]``. For a walk around one pose:
    ``[pose]`` and ``turn=360``. Of more than 240 poses it shows 240, evenly chosen, with the first
    and the last. A pose that is not finite, or that reaches 5 times as far as the others, is cut
    off, and its frame says so.

    **Arguments**

    - path: a ``.gif`` file, or ``.mp4`` if the package imageio-ffmpeg is installed; replaced as a
      whole or not at all.
    - mesh: gives the faces.
    - poses: a list of positions (vertices, 3), or an array (frames, vertices, 3) such as
      ``deform_path(...).vertices``.
    - values: shown as colour: a number, one per vertex (vertices,), or one per frame and vertex
      (frames, vertices). Or the text ``"stretch"``. See `render`.
    - label, handles, moved, up, edges: as in `render`.
    - turn: by how many degrees the view goes around the up axis, in all.
    - seconds: how long the film takes, above 0.
    - width: the width in pixels, from 16.

    **Raises** InputError: as `render`; the name ends neither in .gif nor in .mp4; the film needs
    more than 200 million pixels in all.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> mesh = jd.shapes.square()
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bend.gif"
        >>> poses = [jd.bend(mesh.vertices, angle) for angle in (10, 20, 30)]
        >>> jd.animate(path, mesh, poses, width=100)
        >>> path.stat().st_size > 1000
        True
    """
    path = read_path("path", path)
    check_picture_path(path, ".gif", ".mp4")
    look = read_look(mesh, handles, moved, up, edges)
    arrays = read_poses(mesh, poses)
    if not isinstance(values, str):
        values = _read_values(values, arrays)
    degrees = _read_turn(turn)
    check_tolerance("seconds", seconds, positive=True)
    if len(arrays) == 1 and degrees:
        count = max(2, min(_MOST_FRAMES, round(abs(degrees) / _STEP)))
        arrays, values = arrays * count, values if isinstance(values, str) else values * count
    elif len(arrays) > _MOST_FRAMES:
        chosen = np.linspace(0, len(arrays) - 1, _MOST_FRAMES).round().astype(int)
        arrays = [arrays[k] for k in chosen]
        values = values if isinstance(values, str) else [values[k] for k in chosen]
    # A film of a whole turn does not show the first view again at its end.
    turns = np.radians(degrees) * np.arange(len(arrays)) / len(arrays)
    surface, faults, paint, views, dots = set_up(look, arrays, values, label, turns)
    most = (_MOST_PIXELS / 1.5 / len(arrays)) ** 0.5
    check_count("width", width, least=16, most=int(most))
    height = panel_height(width, views[0])
    sheet = sheet_of(width, height, paint, dots)
    titles = [[Text(fault.words, warns=True)] * bool(fault.words) for fault in faults]
    lines = max(len(sheet.wrapped(title)) for title in titles)
    with closing(Stage(surface, width, height, edges=edges)) as stage:
        images = []
        for pose, coat, view, title in zip(arrays, paint.coats, views, titles, strict=True):
            panel = stage.draw(pose, coat, view, dots)
            # Every frame has room for the longest title, so that none jumps.
            images.append(sheet.arrange([panel], [title], 1, title_lines=lines))
    # What the format can say, in milliseconds.
    write_film(path, images, int(np.clip(1000 * seconds / len(images), 20, 600_000)))


def _read_values(values: Any, poses: list[np.ndarray]) -> list[Any]:
    """Return one array (vertices,) or None per frame."""
    if values is None:
        return [None] * len(poses)
    given = read_host_array(values, np.float64, "values")
    if given.ndim == 2:
        if len(given) != len(poses):
            raise InputError(
                f"values has {len(given)} rows for {len(poses)} poses: give one row per pose, or "
                "one number per vertex"
            )
        return [read_value(f"values[{k}]", row, poses[k]) for k, row in enumerate(given)]
    return [read_value("values", given, poses[0])] * len(poses)


def _read_turn(turn: Any) -> float:
    """Return a finite angle in degrees."""
    real = isinstance(turn, int | float | np.integer | np.floating) and not isinstance(turn, bool)
    if not real or not abs(turn) <= 36000:
        raise InputError(f"turn is {shown(turn)}: give an angle in degrees, such as 360")
    return float(turn)
