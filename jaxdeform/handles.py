"""Handles: which vertices are held, where they go, and the files that say so."""

import json
import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int
from scipy.spatial.transform import Rotation

from jaxdeform.mesh import InputError, Mesh
from jaxdeform.shapes import rotation_matrices

# ---------------------------------------------------------------- checks of the arguments


def check_handles(handles: ArrayLike, n: int) -> Int[np.ndarray, "h"]:
    """Return handle indices as an array, or raise InputError naming what is wrong."""
    given = np.asarray(handles)
    if given.ndim != 1:
        raise InputError(f"handles have shape {given.shape}: give one list of vertex indices")
    if given.size == 0:
        raise InputError("no handles: without any the mesh may lie anywhere; give at least one")
    if given.dtype.kind not in "iu":
        hint = ": use np.flatnonzero(mask)" if given.dtype == bool else ""
        raise InputError(f"handles must be integers, got {given.dtype}{hint}")
    outside = np.flatnonzero((given < 0) | (given >= n))
    if outside.size:
        raise InputError(
            f"handle {given[outside[0]]} (position {outside[0]}) is out of range: the mesh has "
            f"vertices 0 to {n - 1}"
        )
    unique, count = np.unique(given, return_counts=True)
    if (count > 1).any():
        raise InputError(
            f"vertex {unique[count > 1][0]} is a handle {count.max()} times: list it "
            "once, since it can have one target only"
        )
    return given.astype(np.int64)


def check_handle_weights(weights: ArrayLike, index: np.ndarray) -> np.ndarray:
    """Return one weight per handle, infinite for a hard one, or raise InputError."""
    given = np.asarray(weights, np.float64)
    if given.ndim and given.shape != index.shape:
        raise InputError(
            f"handle_weights have shape {given.shape}: give one number or one per handle, "
            f"{index.shape}"
        )
    given = np.broadcast_to(given, index.shape)
    bad = np.flatnonzero(~(given >= 0))
    if bad.size:
        raise InputError(
            f"the weight of handle {index[bad[0]]} is {given[bad[0]]}: give 0 or more, np.inf to "
            "fix it"
        )
    return given


def check_components(mesh: Mesh, anchored: np.ndarray, referenced: np.ndarray) -> None:
    """Raise InputError where a connected part of the mesh has no handle."""
    n = mesh.n_vertices
    i, j = mesh.edges.T
    graph = sp.coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(n, n))
    _, label = sp.csgraph.connected_components(graph, directed=False)
    held = np.zeros(label.max() + 1, bool)
    held[label[anchored]] = True
    loose = np.flatnonzero(referenced & ~held[label])
    if loose.size:
        k = int(loose[0])
        size = int((label == label[k]).sum())
        raise InputError(
            f"the connected part with vertex {k} ({size} vertices) has no handle, so it could lie "
            "anywhere: add a handle there, or drop the part"
        )


def known(x) -> bool:
    """Return whether an array's values can be read now (they cannot while JAX traces)."""
    return not isinstance(x, Tracer)


def check_targets(targets: ArrayLike, count: int, dtype: np.dtype) -> Array | np.ndarray:
    """Return targets as an array (h, 3), or raise InputError naming what is wrong."""
    return read_positions("targets", targets, (count, 3), dtype, unit="handle")


def check_positions(name: str, value, shape: tuple, dtype: np.dtype, unit: str = "vertex") -> Array:
    """Return a JAX array of this shape, finite where its values are known, or raise InputError."""
    return jnp.asarray(read_positions(name, value, shape, dtype, unit))


def read_positions(
    name: str, value, shape: tuple, dtype: np.dtype, unit: str = "vertex"
) -> Array | np.ndarray:
    """Like :func:`check_positions`, but leave on the host what is there."""
    array = read_array(value, dtype, name)
    if array.shape != shape:
        raise InputError(f"{name} have shape {array.shape}, expected {shape}: one row per {unit}")
    if known(array):
        bad = np.flatnonzero(~np.isfinite(np.asarray(array)).reshape(shape[0], -1).all(axis=1))
        if bad.size:
            raise InputError(f"{name} of {unit} {bad[0]} are not finite: give real positions")
    return array


def as_array(value, dtype: np.dtype, name: str) -> Array:
    """Return value as a JAX array, or raise InputError naming the argument."""
    return jnp.asarray(read_array(value, dtype, name))


def read_array(value, dtype: np.dtype, name: str) -> Array | np.ndarray:
    """Like :func:`as_array`, but leave on the host what is there.

    A compiled function takes an array of NumPy's as it is, 0.1 ms sooner than one that JAX is still
    copying.
    """
    try:
        if isinstance(value, np.ndarray | float | int) and np.asarray(value).dtype.kind in "iuf":
            with np.errstate(over="ignore"):  # what does not fit is infinite, and found to be
                return np.asarray(value, dtype)
        return jnp.asarray(value, dtype)
    except (TypeError, ValueError) as error:
        if isinstance(value, Tracer):
            raise
        raise InputError(f"{name} cannot be read as numbers: {error}") from error


# ---------------------------------------------------------------- groups that move rigidly


def rigid_targets(
    points: ArrayLike,
    group: ArrayLike,
    rotations: ArrayLike,
    translations: ArrayLike,
    centers: ArrayLike | None = None,
) -> Float[Array, "h 3"]:
    """Return the targets of handle groups, each moved with six degrees of freedom.

    ``target = R_g (p - center_g) + center_g + t_g``; a rotation is a rotation vector (its length is
    the angle in radians), smooth at zero, so gradients reach rotations and translations.

    **Arguments**

    - points: (h, 3) rest positions of the handles.
    - group: (h,) the group of each handle, 0 to g - 1.
    - rotations: (g, 3) rotation vectors; translations: (g, 3).
    - centers: (g, 3); each group's centroid if left out.

    **Raises** InputError: shapes that do not fit; a group out of range.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> points = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        >>> turn = [[0.0, 0.0, np.pi / 2]]
        >>> moved = jd.rigid_targets(points, [0, 0], turn, [[0.0, 0.0, 5.0]])
        >>> np.allclose(moved, [[0.0, 1.0, 5.0], [0.0, -1.0, 5.0]], atol=1e-6)
        True
    """
    points = jnp.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points have shape {points.shape}: give (h, 3)")
    # Whole numbers are positions too, but rotations are not to be cut down to them.
    dtype = points.dtype if points.dtype.kind == "f" else jnp.result_type(float)
    points = check_positions("points", points, points.shape, dtype, unit="handle")
    rotations = as_array(rotations, dtype, "rotations")
    if rotations.ndim != 2 or rotations.shape[1] != 3:
        raise InputError(f"rotations have shape {rotations.shape}: give (g, 3) rotation vectors")
    shape = rotations.shape
    rotations = check_positions("rotations", rotations, shape, dtype, unit="group")
    translations = check_positions("translations", translations, shape, dtype, unit="group")
    group = check_groups(group, len(points))
    if len(group) and group.max() >= len(rotations):
        raise InputError(
            f"group {group.max()} is out of range: there are rotations for groups 0 to "
            f"{len(rotations) - 1}"
        )
    if centers is None:
        size = np.maximum(np.bincount(group, minlength=len(rotations)), 1)
        total = jnp.zeros(shape, dtype).at[group].add(points)
        centers = total / jnp.asarray(size, dtype)[:, None]
    else:
        centers = check_positions("centers", centers, shape, dtype, unit="group")
    moved = jnp.einsum(
        "hij,hj->hi",
        rotation_matrices(rotations)[group],
        points - centers[group],
        precision="highest",
    )
    return moved + (centers + translations)[group]


def check_groups(group: ArrayLike, count: int) -> Int[np.ndarray, "h"]:
    """Return one group number >= 0 per handle, or raise InputError naming what is wrong."""
    given = np.asarray(group)
    if given.shape != (count,) or given.dtype.kind not in "iu":
        raise InputError(
            f"group has shape {given.shape} and type {given.dtype}: give one integer per handle, "
            f"({count},)"
        )
    bad = np.flatnonzero(given < 0)
    if bad.size:
        raise InputError(f"the group of handle {bad[0]} is {given[bad[0]]}: number them from 0")
    return given.astype(np.int64)


# ---------------------------------------------------------------- files


class HandleFile(NamedTuple):
    """Handles as a file gives them."""

    handles: Int[np.ndarray, "h"]
    targets: Float[np.ndarray, "h 3"]


def load_handles(
    path: str | os.PathLike, mesh: Mesh, motion: str | os.PathLike | None = None
) -> HandleFile:
    """Read handles and their targets from a file.

    Two formats:

    - ``.json``: ``{"handles": [{"vertices": [0, 1], ...}, ...]}``, each group with any of
      ``"rotation": {"axis": [0, 1, 0], "degrees": 90, "center": [0, 0, 0]}`` (centre: the group's
      centroid if left out), ``"translation": [1, 0, 0]``, or ``"targets": [[x, y, z], ...]``.
      A group with none of them stays where it is.
    - ``.sel`` with ``.def`` (survey of Botsch and Sorkine 2008): a number per vertex, 0 fixed,
      1 free, 2 handle, and the 4x4 matrix of the handle. The .def beside the .sel is taken.

    **Arguments**: path; mesh, whose rest positions the motions apply to; motion, another .def file.

    **Returns** (handles (h,), targets (h, 3)).

    **Raises** InputError naming the file and the group or line.

    Example:
        >>> import jaxdeform as jd, json, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "handles.json"
        >>> _ = path.write_text(json.dumps({"handles": [{"vertices": [0, 1]}]}))
        >>> jd.load_handles(path, jd.shapes.bar()).handles
        array([0, 1])
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".sel":
        beside = path.with_suffix(".def") if motion is None else Path(motion)
        handles, targets = _parse_survey(path, beside, mesh)
    elif suffix != ".json":
        raise InputError(f"{path}: handle files end in .json or .sel, not '{path.suffix}'")
    elif motion is not None:
        raise InputError(f"{path}: a .json file holds its motions itself: leave out {motion}")
    else:
        handles, targets = _parse_json(path, mesh)
    try:
        handles = check_handles(handles, mesh.n_vertices)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return HandleFile(handles, targets)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): check the name") from error
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no text file: is it another kind of file?") from None


def _parse_json(path: Path, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    try:
        content = json.loads(_read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}): mend it there") from error
    groups = content.get("handles") if isinstance(content, dict) else None
    if not isinstance(groups, list) or not groups:
        raise InputError(f'{path}: give {{"handles": [group, ...]}}, with one group at least')
    handles, targets = [], []
    for number, group in enumerate(groups):
        where = f"{path}: group {number}"
        if not isinstance(group, dict) or "vertices" not in group:
            raise InputError(f'{where} has no "vertices": list the vertex indices')
        _check_keys(where, group, "vertices", "rotation", "translation", "targets", "name")
        try:
            index = check_handles(group["vertices"], mesh.n_vertices)
        except (InputError, ValueError) as error:
            raise InputError(f"{where}: {error}") from error
        handles.append(index)
        targets.append(_moved(where, group, mesh.vertices[index]))
    return np.concatenate(handles), np.concatenate(targets)


def _check_keys(where: str, given: dict, *known: str) -> None:
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise InputError(f"{where} has the unknown key '{unknown[0]}': use {', '.join(known)}")


def _moved(where: str, group: dict, points: np.ndarray) -> np.ndarray:
    if "targets" in group:
        if "rotation" in group or "translation" in group:
            raise InputError(f"{where} has targets and a motion: give one of them")
        return _numbers(where, "targets", group["targets"], points.shape)
    if "rotation" in group:
        turn = group["rotation"]
        if not isinstance(turn, dict) or "degrees" not in turn or "axis" not in turn:
            raise InputError(f'{where}: rotation needs "axis" and "degrees"')
        _check_keys(f"{where}: rotation", turn, "axis", "degrees", "center")
        axis = _numbers(where, "axis", turn["axis"], (3,))
        length = np.linalg.norm(axis)
        if length == 0:
            raise InputError(f"{where}: the rotation axis has length zero: give a direction")
        degrees = _numbers(where, "degrees", turn["degrees"], ())
        center = points.mean(axis=0)
        if "center" in turn:
            center = _numbers(where, "center", turn["center"], (3,))
        # scipy's rotation is double precision, whatever JAX is set to.
        rotation = Rotation.from_rotvec(axis / length * np.radians(degrees))
        points = rotation.apply(points - center) + center
    if "translation" in group:
        points = points + _numbers(where, "translation", group["translation"], (3,))
    return points


def _numbers(where: str, name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: {name}: give numbers") from None
    if array.shape != shape or not np.isfinite(array).all():
        size = f"{' x '.join(map(str, shape))} finite numbers" if shape else "one finite number"
        raise InputError(f"{where}: {name}: give {size}")
    return array


def _parse_survey(path: Path, motion: Path, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    status = np.array([word for row in _words(path) for word in row])
    if len(status) != mesh.n_vertices:
        raise InputError(
            f"{path}: has {len(status)} numbers, the mesh {mesh.n_vertices} vertices: is it of "
            "another mesh?"
        )
    strange = np.flatnonzero(~np.isin(status, ["0", "1", "2"]))
    if strange.size:
        raise InputError(
            f"{path}: vertex {strange[0]} is '{status[strange[0]]}': 0 fixed, 1 free, 2 handle"
        )
    matrix = _numbers(str(motion), "the matrix", _words(motion), (4, 4))
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise InputError(
            f"{motion}: the matrix ends in the row {matrix[3].tolist()}: give 0 0 0 1 there, and "
            "the translation in the last column"
        )
    handles = np.flatnonzero(status != "1")
    targets = mesh.vertices[handles].copy()
    grabbed = status[handles] == "2"
    targets[grabbed] = targets[grabbed] @ matrix[:3, :3].T + matrix[:3, 3]
    return handles, targets


def _words(path: Path) -> list[list[str]]:
    """Return the words of each line, without comments and empty lines."""
    rows = [line.split("#")[0].split() for line in _read_text(path).splitlines()]
    return [row for row in rows if row]
