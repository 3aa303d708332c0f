"""Handle files: JSON, and the .sel/.def pairs of the survey of Botsch and Sorkine (2008)."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._arrays import read_numbers
from jaxdeform._checks import check_type, read_path
from jaxdeform._errors import InputError, shown
from jaxdeform._handles.targets import rotate, run_motion, translate
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.reading import read_json, read_text
from jaxdeform._mesh.select import some_where
from jaxdeform._mesh.selection import check_handles
from jaxdeform._mesh.words import real


class HandleFile(NamedTuple):
    """Handles and their targets, as a file gives them.

    **Fields**

    - handles: (handles,) vertex indices.
    - targets: (handles, 3) where each handle moves to, in the unit of the mesh.
    """

    handles: Int[np.ndarray, "handles"]
    targets: Float[np.ndarray, "handles 3"]


def load_handles(
    path: str | os.PathLike[str], mesh: Mesh, motion: str | os.PathLike[str] | None = None
) -> HandleFile:
    """Read handles and their targets from a file.

    There are two formats:

    - ``.json``: ``{"handles": [{"where": "y < 0.1"}, {"vertices": [0, 1], ...}, ...]}``. A group
      names its vertices by an expression (see ``jd.select.where``), by their indices, or by a mask
      of booleans. It may have
      ``"rotation": {"axis": [0, 1, 0], "degrees": 90, "center": [0, 0, 0]}`` (by default the centre
      is the centroid of the group; the axis may be ``"y"`` too), ``"translation": [1, 0, 0]``, or
      both (rotated first), or instead ``"targets": [[x, y, z], ...]``. A group with none of them
      stays where it is.
    - ``.sel`` with ``.def``: one number per vertex (0 fixed, 1 free, 2 handle), and the 4x4 matrix
      of the handle. Format of Botsch and Sorkine, "On linear variational surface deformation
      methods" (2008), doi:10.1109/TVCG.2007.1054.

    **Arguments**

    - path: a ``.json`` or ``.sel`` file.
    - mesh: its rest positions are what the motions apply to.
    - motion: the ``.def`` file; by default the one with the name of the ``.sel`` file.

    **Returns** a `HandleFile`: handles (handles,) and targets (handles, 3).

    **Raises** InputError naming the file, and the group or vertex.

    Example:
        >>> import jaxdeform as jd, json, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "handles.json"
        >>> _ = path.write_text(json.dumps({"handles": [{"where": "y < 6"}]}))
        >>> len(jd.load_handles(path, jd.shapes.bar()).handles)
        73
    """
    path = read_path("path", path)
    check_type("mesh", mesh, Mesh)
    motion = None if motion is None else read_path("motion", motion)
    beside = motion_beside(path)
    if beside is not None:
        handles, targets = _parse_survey(path, motion or beside, mesh)
    elif path.suffix.lower() != ".json":
        raise InputError(f"{path}: handle files end in .json or .sel, not '{path.suffix}'")
    elif motion is not None:
        raise InputError(f"{path}: a .json file holds its motions itself: leave out {motion}")
    else:
        handles, targets = _parse_json(path, mesh)
    try:
        handles = check_handles(handles, mesh)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return HandleFile(handles, targets)


def motion_beside(path: Path) -> Path | None:
    """Return the ``.def`` file that belongs to a ``.sel`` file; other handle files have none."""
    return path.with_suffix(".def") if path.suffix.lower() == ".sel" else None


def _parse_json(path: Path, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    content = read_json(path)
    groups = content.get("handles") if isinstance(content, dict) else None
    if not isinstance(groups, list) or not groups:
        raise InputError(f'{path}: give {{"handles": [group, ...]}}, with at least one group')
    handles, targets = [], []
    for number, group in enumerate(groups):
        where = f"{path}: group {number}"
        if not isinstance(group, dict) or ("vertices" in group) == ("where" in group):
            raise InputError(
                f'{where}: give either "vertices", a list of indices, or "where", an expression '
                'such as "y < 0.1"'
            )
        keys = "vertices", "where", "rotation", "translation", "targets", "name"
        _check_keys(where, group, *keys)
        index = _chosen(where, group, mesh)
        handles.append(index)
        targets.append(_moved(where, group, mesh.vertices[index]))
    return np.concatenate(handles), np.concatenate(targets)


def _chosen(where: str, group: dict[str, Any], mesh: Mesh) -> Int[np.ndarray, "chosen"]:
    if "where" in group:
        return some_where(mesh, group["where"], f"{where}: where").vertices
    try:
        return check_handles(group["vertices"], mesh)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _check_keys(where: str, given: dict[str, Any], *keys: str) -> None:
    unknown = sorted(set(given) - set(keys))
    if unknown:
        raise InputError(f"{where} has the unknown key {shown(unknown[0])}: use {', '.join(keys)}")


def _moved(where: str, group: dict[str, Any], points: np.ndarray) -> np.ndarray:
    if "targets" in group:
        if "rotation" in group or "translation" in group:
            raise InputError(f"{where} has targets and a motion: give one of them")
        return _numbers(where, "targets", group["targets"], points.shape)
    if "rotation" in group:
        given = group["rotation"]
        if not isinstance(given, dict) or "degrees" not in given or "axis" not in given:
            raise InputError(f'{where}: rotation needs "axis" and "degrees"')
        _check_keys(f"{where}: rotation", given, "axis", "degrees", "center")
        axis, center = given["axis"], None
        if not isinstance(axis, str):
            axis = _numbers(where, "axis", axis, (3,))
        degrees = _numbers(where, "degrees", given["degrees"], ())
        if "center" in given:
            center = _numbers(where, "center", given["center"], (3,))
        points = _run(f"{where}: rotation", rotate, points, degrees, axis=axis, center=center)
    if "translation" in group:
        offset = _numbers(where, "translation", group["translation"], (3,))
        points = _run(f"{where}: translation", translate, points, offset)
    return points


def _run(where: str, motion: Callable[..., Any], *arguments, **settings) -> np.ndarray:
    """Return where the points move to, or raise InputError with the place in the file."""
    try:
        return np.asarray(motion(*arguments, **settings))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _numbers(where: str, name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = read_numbers(value, name)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    if array.dtype == bool:
        raise InputError(f"{where}: {name}: true and false are no numbers: give numbers")
    array = array.astype(np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        size = f"{' x '.join(map(str, shape))} finite numbers" if shape else "one finite number"
        raise InputError(f"{where}: {name}: give {size}")
    return array


def _parse_survey(path: Path, motion: Path, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    words = [word for row in _words(path) for word in row]
    if len(words) != mesh.n_vertices:
        raise InputError(
            f"{path}: has {len(words)} numbers, but the mesh has {mesh.n_vertices} vertices: give "
            "the file of this mesh"
        )
    for vertex, word in enumerate(words):  # before an array, where all take the longest's room
        if word not in ("0", "1", "2"):
            raise InputError(
                f"{path}: vertex {vertex} is {shown(word)}: give 0 (fixed), 1 (free) or 2 (handle)"
            )
    status = np.array(words)
    try:
        rows = [[real(word.encode()) for word in row] for row in _words(motion)]
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{motion}: the matrix: give numbers") from None
    matrix = _numbers(str(motion), "the matrix", rows, (4, 4))
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise InputError(
            f"{motion}: the matrix ends in the row {matrix[3].tolist()}: give 0 0 0 1 there, and "
            "the translation in the last column"
        )
    handles = np.flatnonzero(status != "1")
    targets = mesh.vertices[handles].copy()
    grabbed = status[handles] == "2"
    move = partial(run_motion, lambda points: points @ matrix[:3, :3].T + matrix[:3, 3])
    targets[grabbed] = _run(f"{motion}: the matrix", move, targets[grabbed])
    return handles, targets


def _words(path: Path) -> list[list[str]]:
    """Return the words of each line; comments and empty lines are left out."""
    rows = [line.split("#")[0].split() for line in read_text(path).splitlines()]
    return [row for row in rows if row]
