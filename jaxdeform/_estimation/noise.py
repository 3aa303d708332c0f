"""Noise of observed handles: how it reaches the free vertices, and how to weight for it.

Where targets are observed positions, their noise moves the free vertices too. The covariance of the
residual is then S = I + D D^T, D = d vertices / d targets, for noise of size 1 in each coordinate.
Few of its modes are far from the identity. Those are found by random probing: D D^T is nearly
U U^T. The residual is weighted by W = (I + U U^T)^-1.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._deformation.solve import deform
from jaxdeform._estimation.poses import Poses, deformed

# Half-width of the 95 % interval of the normal distribution, in standard deviations.
NORMAL_95 = 1.959964
# Of the bar's 438 handle coordinates about 40 move the free vertices by more than themselves.
_MODES = 32
_PROBES = 8


def whiten(columns: Float[np.ndarray, "poses coordinates columns"], modes) -> np.ndarray:
    """Return W^(1/2) times columns; the columns themselves without modes.

    With U^T U = Q diag(s^2 - 1) Q^T, W^(1/2) = I - U Q diag(1 / (s (s + 1))) Q^T U^T.
    """
    if modes is None:
        return columns
    transposed = np.swapaxes(modes, 1, 2)
    squares, basis = np.linalg.eigh(transposed @ modes)
    s = np.sqrt(1.0 + np.maximum(squares, 0.0))
    inner = (basis / (s * (s + 1.0))[:, None, :]) @ np.swapaxes(basis, 1, 2)
    return columns - modes @ (inner @ (transposed @ columns))


class Sandwich(NamedTuple):
    """The covariance of an estimate whose weights W are only nearly the inverse of S."""

    freedom: float
    """Degrees of freedom: tr(W S) - parts."""
    meat: Float[np.ndarray, "parts parts"]
    """J^T W S W J, which stands between two inverses of J^T W J."""


def sandwich(problem, poses: Poses, field, jacobian, modes, solver, adjoint) -> Sandwich:
    """Return the sandwich with the exact S, so that intervals are right although W has few modes.

    The trace is Hutchinson's estimate.
    """
    shape, count = poses.observed.shape, jacobian.shape[-1]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (*shape, _PROBES))
    signs = np.where(poses.counted[..., None, None], signs, 0.0)
    flat = np.concatenate([jacobian, signs], axis=-1).reshape(shape[0], -1, count + _PROBES)
    weighted = whiten(whiten(flat, modes), modes)
    rows = np.concatenate([weighted, flat[..., count:]], axis=-1)
    rows = np.moveaxis(rows, -1, 0).reshape(-1, *shape).astype(problem.dtype)
    pulled = np.asarray(_pull_to_handles(problem, poses, field, rows, solver, adjoint))
    pulled = pulled.reshape(len(rows), -1)
    slopes, both, bare = np.split(pulled, [count, count + _PROBES])
    meat = np.einsum("pia,pib->ab", weighted[..., :count], weighted[..., :count])
    trace = np.sum(flat[..., count:] * weighted[..., count:]) + np.sum(both * bare)
    return Sandwich(float(trace) / _PROBES - count, meat + slopes @ slopes.T)


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def _pull_to_handles(
    problem, poses, field, rows, solver, adjoint
) -> Float[Array, "rows poses handles 3"]:
    """Return D^T of each row."""

    def run(targets):
        return deformed(problem, targets, field, solver, adjoint)

    _, pull = jax.vjp(run, poses.targets)
    return jax.vmap(pull)(rows)[0]


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def handle_modes(
    problem, poses: Poses, field, solver, adjoint
) -> Float[Array, "poses coordinates modes"]:
    """Return U of each pose, with U U^T nearly D D^T.

    A randomised range finder (Halko, Martinsson and Tropp 2011): D^T of random vectors spans the
    motions of the handles that move the free vertices most.
    """
    count = min(_MODES, 3 * poses.targets.shape[1])

    def modes(targets, counted):
        def run(targets):
            vertices = deform(problem, targets, field, solver=solver, adjoint=adjoint).vertices
            return jnp.where(counted[:, None], vertices, 0.0)

        vertices, pull = jax.vjp(run, targets)
        push = lambda along: jax.jvp(run, (targets,), (along,))[1]  # noqa: E731
        probes = jax.random.normal(jax.random.key(0), (count, *vertices.shape), vertices.dtype)
        (rows,) = jax.vmap(pull)(probes)
        basis, _ = jnp.linalg.qr(rows.reshape(count, -1).T)
        moved = jax.vmap(push)(basis.T.reshape(count, *targets.shape))
        return moved.reshape(count, -1).T

    return jax.lax.map(lambda pose: modes(*pose), (poses.targets, poses.counted))
