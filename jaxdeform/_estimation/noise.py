"""Noise of observed handles: how it reaches the free vertices, and how to weight for it.

Where targets are observed positions, their noise moves the free vertices too. The covariance of the
residual is then S = I + D D^T, D = d vertices / d targets, for noise of size 1 in each coordinate.
Few of its modes are far from the identity. Those are found by random probing, and the residual is
weighted by the inverse.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.descent import Adjoint
from jaxdeform._deformation.system import System
from jaxdeform._estimation.deformed import Known, State, as_known, pose
from jaxdeform._estimation.poses import Poses
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._linalg.xla import quick_jit

# Of the bar's 438 handle coordinates about 40 move the free vertices by more than themselves.
_MODES = 32
# Motions of the handles whose effects are computed together.
_AT_ONCE = 8
# Where the handles' noise is smooth, not independent, it is large in the leading ones. As many as
# two rigid bodies have do as well as the rigid motions of the handles themselves.
_FREE_MODES = 12


# Residuals of the linear systems: of those that find the motions of the handles, and of those that
# say how far these move the vertices. On a cactus of 5,261 vertices in three poses the search takes
# 22 s, at 1e-10 56 s, and the ends of the interval differ by 0.07 %. At 1e-2 for both, noise alone
# was taken for a model that does not fit.
_FINDING, _MEASURING = 1e-2, 1e-3


class HandleNoise(NamedTuple):
    """Directions in which the noise of the handles moves the free vertices of each pose."""

    basis: Float[np.ndarray, "poses coordinates modes"]
    """Orthonormal."""
    size: Float[np.ndarray, "poses modes"]
    """Relative to the noise of a vertex, largest first; infinite where anything may happen."""
    relative: float = 0.0
    """The noise of a handle, relative to that of a vertex."""

    @classmethod
    def none(cls, poses: Poses) -> "HandleNoise":
        """Return the noise of exact targets."""
        count = len(poses.observed)
        return cls(np.zeros((count, poses.observed[0].size, 0)), np.zeros((count, 0)))

    def whiten(self, columns: Float[np.ndarray, "poses coordinates columns"]) -> np.ndarray:
        """Return W^(1/2) times columns, W = S^-1: where the size is infinite, a projection."""
        along = np.swapaxes(self.basis, 1, 2) @ columns
        return columns - self.basis @ ((1.0 - 1.0 / np.hypot(1.0, self.size))[..., None] * along)

    @property
    def unbounded(self) -> "HandleNoise":
        """The leading directions, with anything allowed along them, and no noise in the others."""
        basis = self.basis[..., :_FREE_MODES]
        return self._replace(basis=basis, size=np.full((len(basis), basis.shape[2]), np.inf))

    @property
    def free(self) -> Float[np.ndarray, "poses vertices 3 free"]:
        """Directions along which the residual says nothing."""
        anything = bool(np.isinf(self.size).any())
        basis = self.basis if anything else self.basis[..., :0]
        return basis.reshape(len(basis), basis.shape[1] // 3, 3, basis.shape[2])


def find_handle_noise(
    problem, poses: Poses, field, ends: list[State], solver, adjoint, relative: float
) -> HandleNoise:
    """Return the noise that targets pass on, which have so much more of it than the vertices.

    ``ends`` are the deformations of this field. A randomised range finder (Halko, Martinsson and
    Tropp 2011): D^T of random vectors spans the motions of the handles that move the free vertices
    most.
    """
    count = min(_MODES, poses.targets[0].size)
    motions = partial(_motions, count=count, solver=solver, adjoint=_no_finer(adjoint, _FINDING))
    known = _known_poses(problem, poses, field, ends)
    found = np.asarray([motions(*pose) for pose in known])
    modes = _effects(problem, known, found, solver, adjoint)
    basis, size, _ = np.linalg.svd(modes, full_matrices=False)
    return HandleNoise(basis, relative * size, relative)


def random_effects(
    problem, poses: Poses, field, ends: list[State], solver, adjoint
) -> Float[np.ndarray, "poses coordinates draws"]:
    """Return how noise of the handles moves the free vertices: some draws, the same every time.

    The noise is of size 1 in each coordinate. ``ends`` are the deformations of this field.
    """
    shape = len(poses.targets), _AT_ONCE, 3, problem.bucket
    motions = np.random.default_rng(0).standard_normal(shape)
    is_handle = np.isin(np.arange(problem.bucket), problem.handles)
    known = _known_poses(problem, poses, field, ends)
    return _effects(problem, known, np.where(is_handle, motions, 0.0), solver, adjoint)


def _effects(
    problem, known: list[tuple[Any, ...]], motions, solver, adjoint
) -> Float[np.ndarray, "poses coordinates motions"]:
    """Return how motions of the handles (poses, motions, 3, vertices) move the free vertices."""
    adjoint = _no_finer(adjoint, _MEASURING)
    moved = [
        [
            np.asarray(_moved(*pose, some, solver, adjoint))
            for some in np.split(own.astype(problem.dtype), range(_AT_ONCE, len(own), _AT_ONCE))
        ]
        for pose, own in zip(known, motions, strict=True)
    ]
    out = np.stack([np.concatenate(own) for own in moved]).astype(np.float64)
    out = np.moveaxis(out[..., : problem.n_vertices], 1, -1)
    return np.swapaxes(out, 1, 2).reshape(len(out), 3 * problem.n_vertices, -1)


def _no_finer(adjoint: Adjoint, tolerance: float) -> Adjoint:
    if not isinstance(adjoint, Implicit):
        return adjoint
    return replace(adjoint, tolerance=max(adjoint.tolerance, tolerance))


def _known_poses(problem, poses: Poses, field, ends: list[State]) -> list[tuple[Any, ...]]:
    """Return what the compiled code takes of each pose."""
    everywhere = fill_up(np.asarray(field, problem.dtype), problem.bucket)
    return [
        (
            problem.system,
            as_known(problem, targets, end),
            fill_up(seen, problem.bucket),
            everywhere,
        )
        for targets, end, seen in zip(poses.targets, ends, poses.counted, strict=True)
    ]


@quick_jit(static=("count", "solver", "adjoint"))
def _motions(
    system: System, known: Known, counted, field, count: int, solver, adjoint
) -> Float[Array, "count 3 vertices"]:
    """Return motions of the handles that move the free vertices most, orthonormal."""
    run = partial(_positions, system, known, counted, field, solver, adjoint)
    positions, pull = jax.vjp(run, known.targets)
    probes = jax.random.normal(jax.random.key(0), (count, *positions.shape), positions.dtype)
    (rows,) = jax.vmap(pull)(probes)
    basis, _ = jnp.linalg.qr(rows.reshape(count, -1).T)
    return basis.T.reshape(count, *known.targets.shape)


@quick_jit(static=("solver", "adjoint"))
def _moved(
    system: System, known: Known, counted, field, motions, solver, adjoint
) -> Float[Array, "motions 3 vertices"]:
    run = partial(_positions, system, known, counted, field, solver, adjoint)
    return jax.vmap(lambda along: jax.jvp(run, (known.targets,), (along,))[1])(motions)


def _positions(system: System, known: Known, counted, field, solver, adjoint, targets):
    positions = pose(system, known._replace(targets=targets), field, solver, adjoint)
    return jnp.where(counted[None], positions, 0.0)
