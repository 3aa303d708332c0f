"""Preconditioned conjugate gradients that say how far they came.

jax.scipy's do not say it; lineax's stop by a test of every entry, which a right-hand side with
zeros never passes, and take no norm of the preconditioner.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._linalg.varying import as_varying

# One vector, of any shape.
Vectors = Float[Array, "..."]


def conjugate_gradients(
    multiply: Callable[[Vectors], Vectors],
    precondition: Callable[[Vectors], Vectors],
    right: Vectors,
    tolerance: float | Float[Array, ""],
    max_steps: int | Int[Array, ""],
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

    def step(at: _State) -> _State:
        product = multiply(at.direction)
        alpha = at.square / dot(at.direction, product)
        residual = at.residual - alpha * product
        z = precondition(residual)
        square = dot(residual, z)
        direction = z + (square / at.square) * at.direction
        return _State(at.steps + 1, at.x + alpha * at.direction, residual, direction, square)

    def unsolved(at: _State) -> Bool[Array, ""]:
        return (at.square > goal) & (at.steps < max_steps)  # NaN fails the comparison

    begin = _State(jnp.zeros((), jnp.int32), jnp.zeros_like(right), right, z, size)
    end = jax.lax.while_loop(unsolved, step, as_varying(begin))
    return end.x, jnp.sqrt(end.square / jnp.where(size > 0, size, 1.0))


class _State(NamedTuple):
    steps: Int[Array, ""]
    x: Vectors
    residual: Vectors
    direction: Vectors
    square: Float[Array, ""]
    """The square of the residual's size."""


def dot(u: Vectors, v: Vectors) -> Float[Array, ""]:
    """Return the inner product."""
    return jnp.sum(u * v)
