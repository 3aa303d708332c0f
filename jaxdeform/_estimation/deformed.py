"""Deforming into all poses, with derivatives and without."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.arguments import DeformSettings, spread_targets
from jaxdeform._deformation.descent import Adjoint, Solver
from jaxdeform._deformation.local_step import Newton
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.solve import deform, solve
from jaxdeform._deformation.system import System
from jaxdeform._estimation.poses import Poses
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._linalg.waiting import wait_for
from jaxdeform._linalg.xla import quick_jit


class State(NamedTuple):
    """Where the solver ended in one pose."""

    vertices: Float[Array, "vertices 3"]
    transforms: Float[Array, "vertices 3 3"]


class PoseDerivatives(NamedTuple):
    """Deformed poses and their derivatives with respect to log rigidity."""

    vertices: Float[np.ndarray, "poses vertices 3"]
    jacobian: Float[np.ndarray, "poses vertices 3 parts"]
    """0 at vertices that do not count."""
    residual: Float[np.ndarray, "poses vertices 3"]
    """0 at vertices that do not count."""
    solver_error: Float[np.ndarray, "poses vertices 3"]
    """From the minimum to where the solver stopped; 0 at vertices that do not count."""
    ends: list[State]
    """Where the solver stopped in each pose."""


def states(problem: Problem, poses: Poses, field, solver: Solver, adjoint: Adjoint) -> list[State]:
    """Deform into each pose, without derivatives.

    A minimum is one wherever the way to it began. Several may exist, and the observed pose is near
    one of them, so it is the start: the answer does not depend on how the pose is turned, either.
    The end of a fixed number of steps depends on the start, which is then that of ``deform``.
    """
    found = []
    for targets, observed in zip(poses.targets, poses.start, strict=True):
        start = observed if isinstance(adjoint, Implicit) else None
        out = deform(problem, targets, field, solver=solver, adjoint=adjoint, start=start)
        found.append(State(out.vertices, out.transforms))
    return found


def positions_of(ends: list[State]) -> Float[np.ndarray, "poses vertices 3"]:
    """Return where the vertices are."""
    return np.stack([np.asarray(end.vertices) for end in ends])


class Known(NamedTuple):
    """A pose whose state is known, in arrays of the size of the problem's bucket.

    They are relative to the centre of the rest shape, and in the cells' principal axes.
    """

    targets: Float[Array | np.ndarray, "*poses 3 vertices"]
    positions: Float[Array | np.ndarray, "*poses 3 vertices"]
    transforms: Float[Array | np.ndarray, "*poses 3 3 vertices"]


def as_known(problem: Problem, targets: Float[np.ndarray, "handles 3"], state: State) -> Known:
    """Return a pose as the compiled code takes it: the same code for all meshes of a bucket."""
    center, count = problem.mesh.center, problem.n_vertices
    axes = np.asarray(problem.system.principal_axes)[..., :count]
    spread = spread_targets(problem, (targets - center).T.astype(problem.dtype))
    positions = (np.asarray(state.vertices) - center).T.astype(problem.dtype)
    transforms = np.einsum("kaj,jik->aik", np.asarray(state.transforms), axes)
    return Known(*(fill_up(x, problem.bucket) for x in (spread, positions, transforms)))


def pose(system: System, known: Known, field, solver, adjoint) -> Float[Array, "3 vertices"]:
    """Return the vertices of one pose, relative to the centre, to be differentiated.

    Implicit derivatives are those of the minimum near the known state, so neither the solver nor
    the local step is part of the program: it compiles in a third of the time of ``deform``.
    """
    energy = ReducedEnergy(Newton())
    inputs = Inputs(jnp.asarray(known.targets), field, system.soft)
    if isinstance(adjoint, Implicit):
        return adjoint.minimum(energy, system, inputs, known.positions, known.transforms)[0]
    out = solve(system, inputs, None, DeformSettings(energy, solver, adjoint))
    return out.vertices.T - system.center[:, None]


def deform_all(problem, poses: Poses, label, theta, solver, adjoint) -> PoseDerivatives:
    """Deform into all poses, with derivatives in forward mode, all parts at once.

    Implicit derivatives are taken at the minimum next to each end, and so are the positions.
    """
    theta = np.asarray(theta, problem.dtype)
    ends = states(problem, poses, np.exp(theta)[label], solver, adjoint)
    everywhere = fill_up(label, problem.bucket)
    each = wait_for(
        [
            _derivatives(
                problem.system,
                as_known(problem, targets, state),
                everywhere,
                theta,
                solver=solver,
                adjoint=adjoint,
            )
            for targets, state in zip(poses.targets, ends, strict=True)
        ]
    )
    count = problem.n_vertices
    relative, slopes = (np.stack([np.asarray(one[k]) for one in each]) for k in range(2))
    vertices = (np.swapaxes(relative[..., :count], 1, 2) + problem.mesh.center).astype(theta.dtype)
    jacobian = np.swapaxes(slopes[:, :, :count], 1, 2)
    counted = poses.counted[..., None]
    error = positions_of(ends) - vertices
    return PoseDerivatives(
        vertices,
        np.where(counted[..., None], jacobian, 0.0),
        residual_of(poses, vertices),
        np.where(counted, error, 0.0),
        ends,
    )


def residual_of(poses: Poses, vertices) -> Float[np.ndarray, "poses vertices 3"]:
    """Return deformed minus observed positions, 0 at vertices that do not count."""
    return np.where(poses.counted[..., None], np.asarray(vertices) - poses.observed, 0.0)


@quick_jit(static=("solver", "adjoint"))
def _derivatives(system: System, known: Known, label, theta, solver, adjoint):
    """Return the vertices of one pose, and their derivatives to each log rigidity."""
    run = lambda theta: pose(system, known, jnp.exp(theta)[label], solver, adjoint)  # noqa: E731
    push = lambda direction: jax.jvp(run, (theta,), (direction,))  # noqa: E731
    return jax.vmap(push, out_axes=(None, -1))(jnp.eye(len(theta), dtype=theta.dtype))
