"""Refusing poses that cannot be poses of this mesh: another unit, a mirror image, another frame."""

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._deformation.problem import Problem
from jaxdeform._errors import InputError
from jaxdeform._mesh.grouping import summed

# The typical edge of a pose is at most so many times as long as at rest, or as short. Inches for
# centimetres make 2.5, which a real stretch can be too; the misfit tells.
_STRETCH = 3.0
# Targets and observed handles of one frame differ by noise, not by this fraction of the diagonal.
_FRAME = 0.05
# A neighbourhood tells its mirror image apart if it is curved: the smallest of the singular values
# of its edges is at least this fraction of the largest.
_CURVED = 0.1


def check_resemblance(
    problem: Problem,
    observed: Float[np.ndarray, "poses vertices 3"],
    seen: Bool[np.ndarray, "poses vertices"],
    targets: Float[np.ndarray, "poses handles 3"] | None,
) -> None:
    """Raise InputError for poses in another unit, mirrored, or in another frame than the targets.

    ``targets`` are those given, if any were.
    """
    for pose, (positions, mask) in enumerate(zip(observed, seen, strict=True)):
        _check_size(problem, pose, positions, mask)
        _check_orientation(problem, pose, positions, mask)
        if targets is not None:
            _check_frame(problem, pose, positions, mask, targets[pose])


def _check_size(problem: Problem, pose: int, positions, mask) -> None:
    i, j = problem.mesh.edges[mask[problem.mesh.edges].all(axis=1)].T
    if not len(i):
        return
    rest = np.linalg.norm(problem.mesh.vertices[i] - problem.mesh.vertices[j], axis=1)
    ratio = np.linalg.norm(positions[i] - positions[j], axis=1) / np.maximum(rest, 1e-300)
    typical = float(np.median(ratio))
    if not 1.0 / _STRETCH <= typical <= _STRETCH:
        raise InputError(
            f"the edges of observed pose {pose} are {typical:.3g} times as long as at rest: is it "
            "in another unit of length, or of another mesh? Scale it, or the rest shape"
        )


def _check_orientation(problem: Problem, pose: int, positions, mask) -> None:
    """Compare the best linear map of each curved neighbourhood: is its determinant negative?"""
    edges, n = problem.mesh.edges, problem.n_vertices
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[mask[both].all(axis=1)]
    e = problem.mesh.vertices[both[:, 1]] - problem.mesh.vertices[both[:, 0]]
    moved = positions[both[:, 1]] - positions[both[:, 0]]
    sums = lambda a, b: summed(  # noqa: E731
        (a[:, :, None] * b[:, None, :]).reshape(-1, 9), both[:, 0], n
    ).reshape(n, 3, 3)
    moments = sums(e, e)
    sizes = np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 0.0))
    curved = sizes[:, 0] > _CURVED * np.maximum(sizes[:, 2], 1e-300)
    if curved.sum() < 4:
        return
    determinants = np.linalg.det(sums(moved, e)[curved])
    mirrored = int((determinants < 0).sum())
    if mirrored > 0.6 * curved.sum():
        raise InputError(
            f"observed pose {pose} is a mirror image of the rest shape ({mirrored} of "
            f"{curved.sum()} curved neighbourhoods are): flip one of its coordinates"
        )


def _check_frame(problem: Problem, pose: int, positions, mask, targets) -> None:
    hard = ~np.asarray(problem.system.free)[problem.handles] & mask[problem.handles]
    if not hard.any():
        return
    off = np.linalg.norm(positions[problem.handles] - targets, axis=1)
    off = np.where(hard, off, 0.0)
    worst = int(off.argmax())
    if np.median(off[hard]) > _FRAME * problem.mesh.diagonal:
        raise InputError(
            f"handle {problem.handles[worst]} of observed pose {pose} lies {off[worst]:.3g} from "
            "its target, and most handles do so: give poses and targets in the same frame, or "
            "leave targets out"
        )
