"""The lowest mode of a symmetric matrix beside another, by a few steps of Lanczos."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdeform._linalg.conjugate_gradients import Vectors, dot


def lowest_mode(
    multiply: Callable[[Vectors], Vectors],
    precondition: Callable[[Vectors], Vectors],
    start: Vectors,
    most: int,
) -> tuple[Float[Array, ""], Vectors]:
    """Return the lowest ``mu`` with ``H x = mu M x``, as far as its sign needs it, and x.

    H is symmetric, ``precondition`` is M^-1, positive definite. The value is that of x itself,
    ``x^T H x`` with ``x^T M x = 1``: never below the true one, so that a negative value proves that
    H has negative curvature. x is 0 where the value is not negative. It stops once the value is
    twice as large as its error bound, or after ``most`` steps.

    The vectors are not kept but made again for x, by a second run, so that memory does not grow
    with the steps. (They lose their orthogonality, which does no harm to the lowest mode.)

    Lanczos, "An iteration method for the solution of the eigenvalue problem of linear differential
    and integral operators" (1950), doi:10.6028/jres.045.026.
    """
    first = precondition(start)
    size = jnp.sqrt(dot(start, first))
    zero, none = jnp.zeros((), start.dtype), jnp.zeros(most, start.dtype)
    begin = _State(start / size, first / size, jnp.zeros_like(start), zero)

    def step(weights, run: "_Run") -> "_Run":
        k, state, *_ = run
        x = run.x + weights[k] * state.z
        w = multiply(state.z) - state.beta * state.before
        value = dot(w, state.z)
        w = w - value * state.q
        z = precondition(w)
        beta = jnp.sqrt(jnp.maximum(dot(w, z), 0.0))
        inverse = jnp.where(beta > 0, 1.0 / jnp.where(beta > 0, beta, 1.0), 0.0)
        after = _State(w * inverse, z * inverse, state.q, beta)
        alphas, betas = run.alphas.at[k].set(value), run.betas.at[k].set(beta)
        return _Run(k + 1, after, alphas, betas, x, *_lowest(alphas, betas, k + 1))

    def known(run: "_Run") -> Array:
        error = run.state.beta * jnp.abs(run.weights[jnp.maximum(run.steps - 1, 0)])
        sure = ~(2.0 * error >= jnp.abs(run.mu))
        return (run.steps >= _LEAST) & sure | (run.steps >= most)

    at = jnp.zeros((), jnp.int32)
    nothing = _Run(at, begin, none, none, jnp.zeros_like(start), zero, none)

    def again(carried):
        turn, old = carried
        ended = lambda run: jnp.where(turn == 0, known(run), run.steps >= old.steps)  # noqa: E731
        go_on = lambda run: ~ended(run)  # noqa: E731
        return turn + 1, jax.lax.while_loop(go_on, partial(step, old.weights), nothing)

    wanted = lambda carried: (carried[0] == 0) | ((carried[0] == 1) & (carried[1].mu < 0.0))  # noqa: E731
    turn, run = jax.lax.while_loop(wanted, again, (at, nothing))
    return run.mu, jnp.where(turn == 2, run.x, 0.0)


class _State(NamedTuple):
    q: Vectors
    """M z."""
    z: Vectors
    before: Vectors
    """The q of the step before."""
    beta: Float[Array, ""]


class _Run(NamedTuple):
    steps: Int[Array, ""]
    state: _State
    alphas: Float[Array, "most"]
    betas: Float[Array, "most"]
    x: Vectors
    mu: Float[Array, ""]
    """The lowest eigenvalue of the tridiagonal matrix of the steps done."""
    weights: Float[Array, "most"]
    """Its eigenvector."""


def _lowest(alphas, betas, steps) -> tuple[Float[Array, ""], Float[Array, "most"]]:
    done = jnp.arange(alphas.shape[0], dtype=steps.dtype) < steps
    diagonal = jnp.where(done, alphas, 1e3 * (1.0 + jnp.max(jnp.abs(alphas))))
    off = jnp.where(done[1:] & (betas[:-1] > 0), betas[:-1], 0.0)
    values, vectors = jnp.linalg.eigh(jnp.diag(diagonal) + jnp.diag(off, 1) + jnp.diag(off, -1))
    return values[0], jnp.where(done, vectors[:, 0], 0.0)


# The first values say little.
_LEAST = 4
