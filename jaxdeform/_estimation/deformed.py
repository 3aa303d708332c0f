"""Deforming into all poses, with derivatives and without."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.descent import Adjoint, Solver
from jaxdeform._deformation.known_solution import minimum_near
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.solve import deform
from jaxdeform._estimation.poses import Poses
from jaxdeform._linalg.waiting import settled
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
    return settled(found)


def pose(problem, targets, field, state: State, solver, adjoint) -> Float[Array, "vertices 3"]:
    """Return the vertices of one pose, whose state is known, to be differentiated."""
    if isinstance(adjoint, Implicit):
        return minimum_near(problem, targets, field, *state, adjoint)
    return deform(problem, targets, field, solver=solver, adjoint=adjoint).vertices


def deform_all(problem, poses: Poses, label, theta, solver, adjoint) -> PoseDerivatives:
    """Deform into all poses, with derivatives in forward mode, all parts at once.

    With implicit derivatives comes a Newton step, so the positions are those of the minimum itself.
    """
    theta = np.asarray(theta, problem.dtype)
    ends = states(problem, poses, np.exp(theta)[label], solver, adjoint)
    each = settled(
        [
            _derivatives(problem, targets, label, theta, state, solver=solver, adjoint=adjoint)
            for targets, state in zip(poses.targets, ends, strict=True)
        ]
    )
    vertices, jacobian = (np.stack([np.asarray(one[k]) for one in each]) for k in range(2))
    counted = poses.counted[..., None]
    error = np.stack([np.asarray(state.vertices) for state in ends]) - vertices
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
def _derivatives(problem, targets, label, theta, state: State, solver, adjoint):
    """Return the vertices of one pose, and their derivatives to each log rigidity."""
    run = lambda theta: pose(problem, targets, jnp.exp(theta)[label], state, solver, adjoint)  # noqa: E731
    push = lambda direction: jax.jvp(run, (theta,), (direction,))  # noqa: E731
    return jax.vmap(push, out_axes=(None, -1))(jnp.eye(len(theta), dtype=theta.dtype))
