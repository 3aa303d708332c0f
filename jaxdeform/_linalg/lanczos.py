"""The lowest mode of a symmetric matrix beside another, by a few steps of Lanczos."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Vectors = Float[Array, "3 v"]


def lowest_mode(
    multiply: Callable[[Vectors], Vectors],
    precondition: Callable[[Vectors], Vectors],
    start: Vectors,
    steps: Int[Array, ""],
    most: int,
) -> tuple[Float[Array, ""], Vectors]:
    """Return the lowest ``mu`` with ``H x = mu M x`` as far as it is known after some steps, and x.

    H is symmetric, ``precondition`` is M^-1, positive definite. The value is that of x itself,
    ``x^T H x`` with ``x^T M x = 1``: never below the true one, so that a negative value proves that
    H has negative curvature. x is 0 where the value is not negative.

    The vectors are not kept but made again for x, by a second run, so that memory does not grow
    with the steps. (They lose their orthogonality, which does no harm to the lowest mode.)

    Lanczos, "An iteration method for the solution of the eigenvalue problem of linear differential
    and integral operators" (1950), doi:10.6028/jres.045.026.
    """
    first = precondition(start)
    size = jnp.sqrt(_dot(start, first))
    begin = _State(start / size, first / size, jnp.zeros_like(start), jnp.zeros((), start.dtype))
    diagonal = jnp.zeros(most, start.dtype)

    def step(weights, k, carried):
        state, alpha, beta, x = carried
        x = x + weights[k] * state.z
        w = multiply(state.z) - state.beta * state.before
        value = _dot(w, state.z)
        w = w - value * state.q
        z = precondition(w)
        norm = jnp.sqrt(jnp.maximum(_dot(w, z), 0.0))
        inverse = jnp.where(norm > 0, 1.0 / jnp.where(norm > 0, norm, 1.0), 0.0)
        state = _State(w * inverse, z * inverse, state.q, norm)
        return state, alpha.at[k].set(value), beta.at[k].set(norm), x

    def run(carried):
        turn, weights, *_ = carried
        begun = begin, diagonal, diagonal, jnp.zeros_like(start)
        _, alpha, beta, x = jax.lax.fori_loop(0, steps, partial(step, weights), begun)
        mu, weights = _lowest(alpha, beta, steps)
        return turn + 1, weights, mu, x

    def wanted(carried):
        turn, _, mu, _ = carried
        return (turn == 0) | ((turn == 1) & (mu < 0.0))

    zero = jnp.zeros((), start.dtype)
    begun = jnp.zeros((), jnp.int32), diagonal, zero, jnp.zeros_like(start)
    _, _, mu, x = jax.lax.while_loop(wanted, run, begun)
    return mu, x


class _State(NamedTuple):
    q: Vectors
    """M z."""
    z: Vectors
    before: Vectors
    """The q of the step before."""
    beta: Float[Array, ""]


def _lowest(alpha, beta, steps) -> tuple[Float[Array, ""], Float[Array, "most"]]:
    """Return the lowest eigenvalue of the tridiagonal matrix of the steps done, and its vector."""
    most = alpha.shape[0]
    done = jnp.arange(most, dtype=steps.dtype) < steps
    inside = done[1:] & (beta[:-1] > 0)
    diagonal = jnp.where(done, alpha, 1e3 * (1.0 + jnp.max(jnp.abs(alpha))))
    off = jnp.where(inside, beta[:-1], 0.0)
    values, vectors = jnp.linalg.eigh(jnp.diag(diagonal) + jnp.diag(off, 1) + jnp.diag(off, -1))
    return values[0], jnp.where(done, vectors[:, 0], 0.0)


def _dot(u: Vectors, v: Vectors) -> Float[Array, ""]:
    return jnp.sum(u * v)
