"""Sparse matrices in ELLPACK form: a product is gathers only, and so is its transpose.

Layout. The vertex is the last axis of every array: positions ``"3 vertices"``. Each operation then
runs over contiguous memory, which is what lets XLA vectorise it.

Batch. Several vectors can be multiplied side by side. The last axis is then that of vertices and
batch, ``v = vertices * batch``, with the batch members of one vertex next to each other: a gather
fetches rows of them, three times as fast as one number at a time. ``jax.vmap`` is turned into this
layout.

Derivatives. JAX would transpose the gathers into scatter-adds, which take ten times as long; the
caller who has the transposed matrix gives it instead. ``y = K x`` is half of the solution of

    [  I  0 ] [u]   [x]
    [ -K  I ] [y] = [0],

and ``lax.custom_linear_solve`` takes a solver of this system and one of its transpose. It needs no
private part of JAX, has forward and reverse mode of any order and vmap, and derivatives to K too,
from the residual of the system. XLA removes the padding (x, 0): the compiled program has the
gathers and the large copies of the bare products (tests/linalg/test_ell.py). Beside a pair of
primitives of our own (private parts of JAX, and no derivatives to K) the values are bitwise equal
and the processor time is the same: K 4.2 and 4.3 ms, K^T 4.4 and 4.5 ms, a Hessian product 12.6 and
12.9 ms, four of them under vmap 34.8 and 33.8 ms (50,298 vertices, 2 cores, a loaded machine).
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Int

from jaxdeform._linalg.buckets import next_of
from jaxdeform._linalg.varying import as_varying

WIDTHS = (8, 12, 16, 20, 24)
"""Slots of a row. One with more entries goes on in overflow rows of half as many slots: a pole of
valence 40 must not widen all."""
# Overflow rows for each row: always some, so that meshes with and without poles share the code.
_FRACTIONS = (0.125,)
# An overflow row is added by scatter, which costs about so many slots.
_SCATTER = 24


class EllMatrix(eqx.Module):
    """A matrix of ``out`` by ``in`` square blocks (vertices, vertices) of one sparsity pattern.

    ``y[i, k] = sum_{j, s} values[i, j, s, k] x[j, columns[s, k]]``. With 51,200 vertices and 1-ring
    cells this takes 1.0 ms where a CSR product takes 3.2 ms (2 cores, float64); BCOO and
    scatter-adds are slower again by a factor of ten.
    """

    columns: Int[Array, "slots vertices"]
    values: Float[Array, "out in slots vertices"]
    overflow_columns: Int[Array, "narrow overflow"]
    overflow_values: Float[Array, "out in narrow overflow"]
    overflow_rows: Int[Array, "overflow"]
    """Rows that the overflow rows continue."""

    @staticmethod
    def build(
        blocks: list[list[sp.csr_matrix]], dtype: np.dtype, width: int | None = None
    ) -> "EllMatrix":
        """Pack a grid of blocks (vertices, vertices).

        The numbers of slots and of overflow rows are of a short series, so that meshes of one
        bucket (buckets.py) share the compiled code. By default they are those that cost least.
        """
        pattern, entries = _with_one_pattern(blocks)
        length = np.diff(pattern.indptr)
        n = len(length)
        shape = _cheapest(length) if width is None else _Shape.of(length, width)
        row = np.repeat(np.arange(n), length)
        position = np.arange(pattern.nnz) - np.repeat(pattern.indptr[:-1], length)
        more = position - shape.width
        overflows = shape.overflows(length)
        first = np.r_[0, np.cumsum(overflows)[:-1]]

        def packed(chosen, slot, at, slots: int, count: int, rest):
            # Empty slots read the row's own vertex: what is near stays near.
            columns = np.broadcast_to(rest, (slots, count)).astype(np.int32)
            columns[slot, at] = pattern.indices[chosen]
            values = np.zeros((*entries.shape[:2], slots, count), dtype)
            values[..., slot, at] = entries[..., chosen]
            return columns, values

        inside, outside = np.flatnonzero(more < 0), np.flatnonzero(more >= 0)
        main = packed(inside, position[inside], row[inside], shape.width, n, np.arange(n))
        slot, at = more[outside] % shape.narrow, first[row[outside]] + more[outside] // shape.narrow
        overflow_rows = np.zeros(shape.rows, np.int32)
        overflow_rows[: overflows.sum()] = np.repeat(np.arange(n), overflows)
        rest = packed(outside, slot, at, shape.narrow, shape.rows, overflow_rows)
        return EllMatrix(*jax.device_put((*main, *rest, overflow_rows)))

    def apply(self, x: Float[Array, "*lead v"], batch: int = 1) -> Float[Array, "*lead v"]:
        """Return the product with x, for a matrix of one block that is symmetric."""
        out = multiply(self, self, split_batch(x, batch)[..., None, :, :])
        return out.reshape(x.shape)


def sparse_blocks(
    columns: Int[np.ndarray, "slots vertices"],
    values: Float[np.ndarray, "out 1 slots vertices"],
    overflow_columns: Int[np.ndarray, "narrow overflow"],
    overflow_values: Float[np.ndarray, "out 1 narrow overflow"],
    overflow_rows: Int[np.ndarray, "overflow"],
) -> list[sp.csr_matrix]:
    """Return the blocks of a matrix of one column of blocks, given its arrays in their order."""
    n, out = columns.shape[1], []
    rows = np.broadcast_to(np.arange(n), columns.shape)
    more_rows = np.broadcast_to(overflow_rows, overflow_columns.shape)
    row = np.concatenate([rows.ravel(), more_rows.ravel()])
    column = np.concatenate([columns.ravel(), overflow_columns.ravel()])
    for block, more in zip(values[:, 0], overflow_values[:, 0], strict=True):
        value = np.concatenate([block.ravel(), more.ravel()])
        used = value != 0.0
        out.append(sp.csr_matrix((value[used], (row[used], column[used])), shape=(n, n)))
    return out


def _with_one_pattern(
    blocks: list[list[sp.csr_matrix]],
) -> tuple[sp.csr_matrix, Float[np.ndarray, "out in entries"]]:
    """Return a pattern that holds the entries of all blocks, and their values at its entries."""
    pattern, *others = [block for row in blocks for block in row]
    same = all(
        np.array_equal(x.indptr, pattern.indptr) and np.array_equal(x.indices, pattern.indices)
        for x in others
    )
    if not same or not pattern.has_sorted_indices:
        pattern = sp.csr_matrix(sum(abs(block) for row in blocks for block in row))
        pattern.sort_indices()
        length = np.diff(pattern.indptr)
        row = np.repeat(np.arange(len(length)), length)
        values = [[np.ravel(x[row, pattern.indices]) for x in line] for line in blocks]
        return pattern, np.array(values)
    return pattern, np.array([[block.data for block in line] for line in blocks])


class _Shape(NamedTuple):
    """The number of slots of a row and of an overflow row, and the number of overflow rows."""

    width: int
    narrow: int
    rows: int

    @staticmethod
    def of(length: Int[np.ndarray, "vertices"], width: int) -> "_Shape":
        shape = _Shape(width, max(width // 2, 1), 0)
        n = max(len(length), 1)
        fraction = next_of(_FRACTIONS, shape.overflows(length).sum() / n)
        return shape._replace(rows=math.ceil(fraction * len(length)))

    def overflows(self, length: Int[np.ndarray, "vertices"]) -> Int[np.ndarray, "vertices"]:
        """Return the number of overflow rows of each row."""
        return -(-np.maximum(length - self.width, 0) // self.narrow)


def _cheapest(length: Int[np.ndarray, "vertices"]) -> _Shape:
    """Return the shape that costs least; length counts the entries of each row."""
    shapes = [_Shape.of(length, width) for width in WIDTHS]
    cost = [x.width * len(length) + (x.narrow + _SCATTER) * x.rows for x in shapes]
    return shapes[int(np.argmin(cost))]


def split_batch(x: Float[Array, "*lead v"], batch: int) -> Float[Array, "*lead vertices batch"]:
    """Return x with vertices and batch on axes of their own."""
    return x.reshape(*x.shape[:-1], -1, batch)


@jax.jit
def multiply(
    matrix: EllMatrix, transpose: EllMatrix, x: Float[Array, "*lead in vertices batch"]
) -> Float[Array, "*lead out vertices batch"]:
    """Return ``matrix @ x``, whose derivative is made with ``transpose``.

    Derivatives to ``matrix.values`` are true ones, of any order, at the cost of scatter-adds in
    the second. ``transpose`` must hold the same numbers and has no derivatives: those of its
    entries are attributed to ``matrix``.
    """
    matrix, transpose, x = as_varying((matrix, transpose, x))
    columns_of_blocks = x.shape[-3]
    zeros = jnp.zeros((*x.shape[:-3], matrix.values.shape[0], *x.shape[-2:]), x.dtype)

    # One array, because a pytree of which one part has a symbolic zero for its tangent fails.
    def join(u, v):
        return jnp.concatenate([u, v], axis=-3)

    def split(z):
        return z[..., :columns_of_blocks, :, :], z[..., columns_of_blocks:, :, :]

    def residual(z):
        u, v = split(z)
        return join(u, v - _product_in_few_operations(matrix, u))

    def solve(_, right):
        u, v = split(right)
        return join(u, v + _product(matrix, u))

    def solve_transposed(_, right):
        u, v = split(right)
        return join(u + _product(transpose, v), v)

    solution = jax.lax.custom_linear_solve(residual, join(x, zeros), solve, solve_transposed)
    return split(solution)[1]


@custom_vmap
def _product(matrix: EllMatrix, x: Float[Array, "*lead in vertices batch"]):
    """Return ``matrix @ x`` slot by slot; nothing differentiates it."""
    return _with_overflow(_product_of_slots, matrix, x)


@_product.def_vmap
def _fold_into_batch(size: int, batched, matrix: EllMatrix, x):
    if any(jax.tree.leaves(batched[0])):  # several matrices: the products one after another
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        return jax.vmap(_product.fun, in_axes=tuple(axes))(matrix, x), True
    x = jnp.moveaxis(x, 0, -1)
    y = _product(matrix, x.reshape(*x.shape[:-2], x.shape[-2] * size))
    return jnp.moveaxis(y.reshape(*y.shape[:-1], x.shape[-2], size), -1, 0), True


def _product_in_few_operations(matrix: EllMatrix, x: Float[Array, "*lead in vertices batch"]):
    """Return ``matrix @ x`` in few operations, traced at every call but run by derivatives only."""

    def product(columns, values, x):
        picked = _pick(x, columns)[..., None, :, :, :, :]
        return jnp.sum(_beside(values, picked) * picked, axis=(-4, -3))

    return _with_overflow(product, matrix, x)


def _with_overflow(product, matrix: EllMatrix, x):
    y = product(matrix.columns, matrix.values, x)
    if matrix.overflow_rows.shape[0]:
        rest = product(matrix.overflow_columns, matrix.overflow_values, x)
        y = y.at[..., matrix.overflow_rows, :].add(rest)
    return y


def _product_of_slots(columns, values, x):
    slots = [(j, s) for j in range(values.shape[1]) for s in range(values.shape[2])]
    picked = [_pick(x[..., j, :, :], columns[s]) for j, s in slots]
    blocks = [
        sum(_beside(values[i, j, s], row) * row for (j, s), row in zip(slots, picked, strict=True))
        for i in range(values.shape[0])
    ]
    return jnp.stack(blocks, axis=-3)


def _pick(x: Float[Array, "*lead vertices batch"], index: Int[Array, "*rows"]):
    # Were negative indices allowed, each entry would be checked for one in the innermost loop: for
    # 16 bars K would take 0.30 instead of 0.05 ms.
    return x.at[..., index, :].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _beside(values: Float[Array, "*rows"], x: Float[Array, "*lead batch"]) -> Float[Array, "..."]:
    """Return values with axes of length 1, so that their last one meets the vertices of x."""
    return values.reshape(*[1] * (x.ndim - values.ndim - 1), *values.shape, 1)
