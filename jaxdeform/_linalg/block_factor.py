"""The factor of symmetric 9x9 matrices, for all cells at once, by blocks of 3x3."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxdeform._linalg.small_matrices import Matrices, Scalars, Vectors, from_grid
from jaxdeform._linalg.small_matrices import product_of_arrays as product
from jaxdeform._linalg.small_matrices import times_vectors as times
from jaxdeform._linalg.small_matrices import transpose_of_array as transpose

Blocks = tuple[tuple[Matrices], tuple[Matrices, Matrices], tuple[Matrices, Matrices, Matrices]]
"""The lower triangle, row by row."""


class BlockFactor(NamedTuple):
    """``L D L^T``, D diagonal, with L in blocks of 3x3.

    The blocks are eliminated by their own triangular factors. By their inverses it takes half the
    time, but the error grows with the square of the condition: cells 1e8 times as rigid as stiff
    had solutions without a right digit, and minima were taken for saddles.

    With the assembly of H it is made in 1.9 ms, and the solution of one right side costs 0.5 ms
    (4,864 cells, one thread, float64; 47 and 10 ms for 50,000). The inverse of H by elimination
    took 7.2 and 0.4 ms (232 and 6): XLA assembles H again in each of its passes. A factor of single
    numbers compiles for 2.7 s.
    """

    below: tuple[Matrices, Matrices, Matrices]
    """L_21, L_31 and L_32."""
    triangles: tuple[Matrices, Matrices, Matrices]
    """The inverses of L_11, L_22 and L_33, lower triangles with a diagonal of 1."""
    pivots: tuple[Vectors, Vectors, Vectors]

    @staticmethod
    def of(matrix: Blocks, floor: Scalars) -> "BlockFactor":
        """Factor; a pivot below ``floor`` (a direction without stiffness) becomes ``floor``."""
        (h11,), (h21, h22), (h31, h32, h33) = matrix
        t1, d1 = _eliminated(h11, floor)
        w21, w31 = (product(h, transpose(t1)) for h in (h21, h31))
        l21, l31 = w21 / d1[None], w31 / d1[None]
        t2, d2 = _eliminated(h22 - product(l21, transpose(w21)), floor)
        w32 = product(h32 - product(l31, transpose(w21)), transpose(t2))
        l32 = w32 / d2[None]
        last = h33 - product(l31, transpose(w31)) - product(l32, transpose(w32))
        t3, d3 = _eliminated(last, floor)
        return BlockFactor((l21, l31, l32), (t1, t2, t3), (d1, d2, d3))

    def solve(self, right: Matrices) -> Matrices:
        """Return x with H x = right, both (block, entry of the block, cell)."""
        (l21, l31, l32), (t1, t2, t3), (d1, d2, d3) = self
        a, b, c = right
        a = times(t1, a)
        b = times(t2, b - times(l21, a))
        c = times(t3, c - times(l31, a) - times(l32, b))
        c = times(transpose(t3), c / d3)
        b = times(transpose(t2), b / d2 - times(transpose(l32), c))
        a = a / d1 - times(transpose(l21), b) - times(transpose(l31), c)
        return jnp.stack([times(transpose(t1), a), b, c])


def _eliminated(matrix: Matrices, floor: Scalars) -> tuple[Matrices, Vectors]:
    """Return the inverse of L and the pivots of a symmetric matrix."""
    bounded = lambda pivot: jnp.where(jnp.abs(pivot) > floor, pivot, floor)  # noqa: E731
    p0 = bounded(matrix[0, 0])
    l10, l20 = matrix[1, 0] / p0, matrix[2, 0] / p0
    p1 = bounded(matrix[1, 1] - l10 * matrix[1, 0])
    rest = matrix[2, 1] - l20 * matrix[1, 0]
    l21 = rest / p1
    p2 = bounded(matrix[2, 2] - l20 * matrix[2, 0] - l21 * rest)
    zero, one = jnp.zeros_like(p0), jnp.ones_like(p0)
    rows = [[one, zero, zero], [-l10, one, zero], [l10 * l21 - l20, -l21, one]]
    return from_grid(rows), jnp.stack([p0, p1, p2])
