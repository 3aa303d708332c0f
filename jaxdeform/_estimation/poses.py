"""Observed poses: checks, and what separates deformed poses from them."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._arrays import read_host_array
from jaxdeform._baselines.laplacian_editing import laplacian_editing
from jaxdeform._deformation.problem import Problem, check_problem, rigidity_from_material
from jaxdeform._errors import InputError
from jaxdeform._estimation.resemblance import check_resemblance
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.selection import read_mask_or_numbers
from jaxdeform._values import read_positions, read_rigidity

# Outside this range of material constants (rigidity over tr(B) / 2) nothing changes any more: the
# bar moves by less than 1e-6 of its size from there to zero and to infinity.
_SOFTEST, _STIFFEST = 1e-7, 1e5
# Where searches start: poses change most around it, from rubber to steel.
MEDIUM = 0.1
# Positions closer than this fraction of the bounding box diagonal are the same: float32 files round
# to it, and the solvers stop there.
_EQUAL = 1e-8


class Poses(NamedTuple):
    """The observed poses, checked, in NumPy."""

    targets: Float[np.ndarray, "poses handles 3"]
    observed: Float[np.ndarray, "poses vertices 3"]
    counted: Bool[np.ndarray, "poses vertices"]
    """Vertices that are free and were seen; the others' positions are 0 in ``observed``."""
    start: Float[np.ndarray, "poses vertices 3"]
    """Where deformations to a minimum start: as observed, so that it is the observed minimum."""

    @property
    def count(self) -> int:
        """Number of coordinates compared."""
        return 3 * int(np.sum(self.counted))

    def root_mean_square(self, residual: Float[np.ndarray, "..."]) -> float:
        """Return the misfit, a length: of residuals that are 0 where nothing counts."""
        return float(np.sqrt(np.sum(residual**2) / max(self.count, 1)))


def same_length(problem: Problem) -> float:
    """Return the length below which positions are the same."""
    return max(_EQUAL, 2.0 * float(np.finfo(problem.dtype).eps)) * problem.mesh.diagonal


def sizes(problem: Problem) -> Float[np.ndarray, "vertices"]:
    """Return the rigidity of each vertex at material constant 1 (flat cells: their mean)."""
    size = np.asarray(rigidity_from_material(problem, 1.0), np.float64)
    return np.where(size > 0, size, size.mean())


def log_bounds(size: Float[np.ndarray, "unknowns"]) -> Float[np.ndarray, "2 unknowns"]:
    """Return the range of log rigidity, for materials whose constant 1 has these rigidities."""
    return np.log([_SOFTEST * size, _STIFFEST * size])


# ---------------------------------------------------------------- checks


def check_poses(problem: Any, observed: Any, targets: Any, mask: Any) -> Poses:
    """Return the poses, or raise InputError naming what is wrong."""
    check_problem(problem)
    given = read_poses("observed", observed, problem.n_vertices, problem.dtype)
    seen = _check_mask(mask, len(given), problem.mesh)
    bad = np.argwhere(seen & ~np.isfinite(given).all(axis=2))
    if len(bad):
        pose, vertex = bad[0]
        raise InputError(
            f"vertex {vertex} of observed pose {pose} is {given[pose, vertex].tolist()} "
            f"({len(bad)} such): mark what was not seen with mask"
        )
    goal = _check_targets(problem, targets, given, seen)
    free = np.asarray(problem.system.free)[: problem.n_vertices]
    counted = seen & free
    if not counted.any():
        move = "observe one that is free (mask)" if free.any() else "leave some out of the handles"
        raise InputError(
            "nothing is free to observe: every vertex is fixed by a handle or was not seen, so the "
            f"poses do not depend on the rigidity; {move}"
        )
    check_resemblance(problem, given, seen, goal if targets is not None else None)
    return _compared(problem, goal, given, counted)


def without(problem: Problem, poses: Poses, dropped: Bool[np.ndarray, "poses vertices"]) -> Poses:
    """Return the poses as if these vertices had not been seen."""
    return _compared(problem, poses.targets, poses.observed, poses.counted & ~dropped)


def _compared(problem, targets, observed, counted) -> Poses:
    """Return the poses, of which these vertices are compared."""
    shown = np.where(counted[..., None], observed, 0.0).astype(problem.dtype)
    return Poses(targets, shown, counted, _starts(problem, shown, counted, targets))


def read_poses(
    name: str, value: Any, n: int, dtype: np.dtype
) -> Float[np.ndarray, "poses vertices 3"]:
    """Return one pose or several, finite or not, or raise InputError naming what is wrong."""
    array = read_host_array(value, dtype, name)
    poses = array[None] if array.ndim == 2 else array
    if poses.ndim != 3 or poses.shape[1:] != (n, 3) or not len(poses):
        raise InputError(
            f"{name} has shape {array.shape}: give one pose ({n}, 3) or several (poses, {n}, 3) of "
            "the same mesh as the rest shape"
        )
    return poses


def _check_mask(mask: Any, poses: int, mesh: Mesh) -> Bool[np.ndarray, "poses vertices"]:
    n = mesh.n_vertices
    seen = read_mask_or_numbers("mask", np.ones(n, bool) if mask is None else mask, mesh)
    if seen.dtype != bool or seen.shape not in ((n,), (poses, n)):
        raise InputError(
            f"mask has shape {seen.shape} and type {seen.dtype}: give booleans ({n},) or "
            f"({poses}, {n}), True where a vertex was seen, or a jd.Selection of this mesh"
        )
    return np.broadcast_to(seen, (poses, n))


def _check_targets(problem, targets, given, seen) -> Float[np.ndarray, "poses handles 3"]:
    """Return the targets given, or the observed positions of the handles."""
    handles, dtype = problem.handles, problem.dtype
    if targets is None:
        hidden = np.argwhere(~seen[:, handles])
        if len(hidden):
            pose, row = hidden[0]
            raise InputError(
                f"handle {handles[row]} was not seen in pose {pose} (mask): give targets, or leave "
                "it out of the handles"
            )
        return given[:, handles]
    goal = read_host_array(targets, dtype, "targets")
    goal = goal[None] if goal.ndim == 2 else goal
    shape = (len(given), len(handles), 3)
    return np.asarray(read_positions("targets", goal, shape, dtype, unit="pose"))


def _starts(problem, observed, counted, goal) -> Float[np.ndarray, "poses vertices 3"]:
    """Return the poses as observed; what was not seen follows by Laplacian editing."""
    starts = np.array(observed)
    starts[:, problem.handles] = goal
    for pose, seen in enumerate(counted):
        seen = seen.copy()
        seen[problem.handles] = True
        if not seen.all():
            at = np.flatnonzero(seen)
            starts[pose] = laplacian_editing(problem.mesh, at, starts[pose, at])
    return starts.astype(problem.dtype)


def check_start(start: Any, default: np.ndarray, unit: str) -> Float[np.ndarray, "unknowns"]:
    """Return the rigidities to start from, or raise InputError naming what is wrong."""
    if start is None:
        return default
    given = read_host_array(start, np.float64, "start")
    count = len(default)
    values = np.asarray(read_rigidity(given, count, given.dtype, name="start", unit=unit))
    if (values <= 0).any():
        raise InputError("start must be above 0, because the search runs on its logarithm")
    return values
