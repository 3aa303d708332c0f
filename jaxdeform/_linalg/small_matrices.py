"""Algebra of 3x3 and 9x9 matrices by components, over all cells at once."""

import jax.numpy as jnp
from jaxtyping import Array, Float

Matrices = Float[Array, "3 3 cells"]
Vectors = Float[Array, "3 cells"]
Scalars = Float[Array, "cells"]
# A grid is a nested Python list of arrays (cells,), one per component. Every product below is then
# one contiguous, vectorised pass, and transposing a matrix costs nothing.
Grid = list[list[Array]]


def as_grid(matrices: Matrices) -> Grid:
    return [[matrices[i, j] for j in range(3)] for i in range(3)]


def from_grid(grid: Grid) -> Matrices:
    return jnp.stack([jnp.stack(row) for row in grid])


def transpose(x: Grid) -> Grid:
    return [[x[j][i] for j in range(3)] for i in range(3)]


def product(x: Grid, y: Grid) -> Grid:
    return [
        [x[i][0] * y[0][j] + x[i][1] * y[1][j] + x[i][2] * y[2][j] for j in range(3)]
        for i in range(3)
    ]


def identity(like: Array) -> Grid:
    one, zero = jnp.ones_like(like), jnp.zeros_like(like)
    return [[one if i == j else zero for j in range(3)] for i in range(3)]


def where(condition: Array, x: Grid, y: Grid) -> Grid:
    return [[jnp.where(condition, x[i][j], y[i][j]) for j in range(3)] for i in range(3)]


def minus_identity(x: Grid) -> Grid:
    return [[x[i][j] - 1.0 if i == j else x[i][j] for j in range(3)] for i in range(3)]


def inner(u: list[Array], v: list[Array]) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u: list[Array], v: list[Array]) -> list[Array]:
    return [
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    ]


def inverse_of_symmetric(
    matrix: Float[Array, "k k cells"], floor: Float[Array, "cells"]
) -> Float[Array, "k k cells"]:
    """Return the inverses of symmetric matrices, by Gauss-Jordan elimination.

    A pivot below ``floor`` (a direction without stiffness) is replaced by ``floor``.

    The loop is unrolled: 3 instead of 9 ms (4,864 cells; 52 instead of 105 for 50,000), and 0.4
    instead of 0.15 s to compile. An L D L^T factor, unrolled into components, is made as fast, but
    compiles for 2.7 s, and its solve takes 13 instead of 3 ms (50,000 cells). A derivative solves
    some 50 times.
    """
    unit = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    for k, e in enumerate(unit[:, :, None]):
        # In the pivot's row and column too: a - (column - e)(row + e) / pivot, e the unit vector.
        row, column = matrix[k], matrix[:, k]
        pivot = jnp.where(jnp.abs(row[k]) > floor, row[k], floor)
        matrix = matrix - (column - e)[:, None] * ((row + e) / pivot[None])[None]
    return matrix


def times_vectors(
    matrix: Float[Array, "k k cells"], vectors: Float[Array, "k cells"]
) -> Float[Array, "k cells"]:
    """Return the product of each matrix with its vector.

    As a sum of columns: 3 ms where ``einsum`` takes 50 (9x9 matrices of 50,000 cells).
    """
    return sum(matrix[:, j] * vectors[j][None] for j in range(1, len(vectors))) + (
        matrix[:, 0] * vectors[0][None]
    )
