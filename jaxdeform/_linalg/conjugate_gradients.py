"""Preconditioned conjugate gradients that say how far they came.

jax.scipy's do not say it; lineax's stop by a test of every entry, which a right-hand side with
zeros never passes, and take no norm of the preconditioner.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# One vector, of any shape.
Vectors = Float[Array, "..."]


def conjugate_gradients(
    multiply: Callable[[Vectors], Vectors],
    precondition: Callable[[Vectors], Vectors],
    right: Vectors,
    tolerance: float,
    max_steps: int,
) -> tuple[Vectors, Float[Array, ""]]:
    """Return x with H x = right, and the size of its residual relative to that of ``right``.

    H is symmetric and so is the preconditioner M, which is positive definite. Sizes are
    ``sqrt(r^T M r)``: near the error in the norm of H, whatever the scale of the mesh.

    Hestenes and Stiefel, "Methods of conjugate gradients for solving linear systems" (1952),
    doi:10.6028/jres.049.044.
    """
    z = precondition(right)
    size = dot(right, z)
    goal = tolerance**2 * size

    def step(state):
        count, x, r, p, square = state
        hp = multiply(p)
        alpha = square / dot(p, hp)
        r = r - alpha * hp
        z = precondition(r)
        new = dot(r, z)
        return count + 1, x + alpha * p, r, z + (new / square) * p, new

    def unsolved(state):
        count, *_, square = state
        return (square > goal) & (count < max_steps)  # NaN fails the comparison

    begin = jnp.zeros((), jnp.int32), jnp.zeros_like(right), right, z, size
    _, x, _, _, square = jax.lax.while_loop(unsolved, step, begin)
    return x, jnp.sqrt(square / jnp.where(size > 0, size, 1.0))


def dot(u: Vectors, v: Vectors) -> Float[Array, ""]:
    """Return the inner product."""
    return jnp.sum(u * v)
