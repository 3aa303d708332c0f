"""Algebra of 3x3 matrices over all cells at once, by components and as whole arrays."""

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


def inner(u: list[Array] | Vectors, v: list[Array] | Vectors) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u: list[Array], v: list[Array]) -> list[Array]:
    return [
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    ]


# Of whole arrays: a product of blocks is then a few operations for the compiler, not 45.


def transpose_of_array(x: Matrices) -> Matrices:
    return jnp.swapaxes(x, 0, 1)


def product_of_arrays(x: Matrices, y: Matrices) -> Matrices:
    return x[:, 0, None] * y[None, 0] + x[:, 1, None] * y[None, 1] + x[:, 2, None] * y[None, 2]


def times_vectors(x: Matrices, v: Vectors) -> Vectors:
    return x[:, 0] * v[0][None] + x[:, 1] * v[1][None] + x[:, 2] * v[2][None]
