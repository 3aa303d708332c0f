"""EllMatrix against dense products and finite differences, and the program that XLA makes of it."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from helpers import EXACT, FD

from jaxdeform._linalg import ell
from jaxdeform._linalg.ell import EllMatrix, multiply

N = 40
GRIDS = {"one": (1, 1), "below each other": (3, 1), "beside each other": (1, 3), "grid": (2, 2)}


def random_blocks(rows: int, columns: int, seed: int = 0) -> list[list[sp.csr_matrix]]:
    """Return sparse blocks, one of whose rows is full: it needs overflow rows."""
    rng = np.random.default_rng(seed)
    mask = rng.random((N, N)) < 0.04
    mask[7] = True
    mask[11] = False
    return [
        [sp.csr_matrix(rng.normal(size=(N, N)) * mask) for _ in range(columns)] for _ in range(rows)
    ]


def dense(blocks) -> np.ndarray:
    return np.array([[block.toarray() for block in row] for row in blocks])


def pair(blocks, dtype=np.float64) -> tuple[EllMatrix, EllMatrix]:
    """Return the matrix and its transpose."""
    transposed = [[row[j].T.tocsr() for row in blocks] for j in range(len(blocks[0]))]
    dtype = np.dtype(dtype)
    return EllMatrix.build(blocks, dtype), EllMatrix.build(transposed, dtype)


def of_entries(rows: int, columns: int):
    """Return a function from the numbers of all entries to (matrix, transpose), and the numbers."""
    blocks = random_blocks(rows, columns)
    numbers = np.concatenate([block.data for row in blocks for block in row])
    first = 1
    numbered = []
    for row in blocks:
        numbered.append([])
        for block in row:
            places = np.arange(first, first + block.nnz, dtype=float)
            numbered[-1].append(sp.csr_matrix((places, block.indices, block.indptr), block.shape))
            first += block.nnz
    places = pair(numbered)

    def build(numbers):
        padded = jnp.concatenate([jnp.zeros(1), numbers])
        return jax.tree.map(
            lambda x: padded[x.astype(jnp.int32)] if x.dtype == jnp.float64 else x, places
        )

    return build, jnp.asarray(numbers)


def vectors(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(5).normal(size=shape))


@pytest.fixture(params=GRIDS.values(), ids=GRIDS)
def grid(request):
    return request.param


def test_product_is_the_dense_one(grid):
    blocks = random_blocks(*grid)
    matrix, transpose = pair(blocks)
    assert matrix.overflow_rows.shape[0]
    x, y = vectors(2, grid[1], N, 3), vectors(2, grid[0], N, 3)
    want = np.einsum("ijkl,djlb->dikb", dense(blocks), x)
    np.testing.assert_allclose(multiply(matrix, transpose, x), want, atol=EXACT)
    want = np.einsum("ijkl,dikb->djlb", dense(blocks), y)
    np.testing.assert_allclose(multiply(transpose, matrix, y), want, atol=EXACT)


def test_apply_multiplies_by_a_symmetric_matrix():
    block = random_blocks(1, 1)[0][0]
    block = sp.csr_matrix(block + block.T)
    matrix = EllMatrix.build([[block]], np.dtype(float))
    x = vectors(2, 3, N)
    np.testing.assert_allclose(matrix.apply(x), x @ block.toarray(), atol=EXACT)
    beside = jnp.moveaxis(x, 0, -1).reshape(3, N * 2)
    found = matrix.apply(beside, 2).reshape(3, N, 2)
    np.testing.assert_allclose(jnp.moveaxis(found, -1, 0), x @ block.toarray(), atol=EXACT)


def test_matrices_without_entries_or_vertices():
    for n in (0, 3):
        matrix = EllMatrix.build([[sp.csr_matrix((n, n))]], np.dtype(float))
        np.testing.assert_array_equal(matrix.apply(jnp.ones((2, n))), np.zeros((2, n)))


def test_single_precision_stays():
    matrix, transpose = pair(random_blocks(1, 3), np.float32)
    x = vectors(3, N, 1).astype(jnp.float32)
    assert multiply(matrix, transpose, x).dtype == np.float32
    assert jax.grad(lambda x: jnp.sum(multiply(matrix, transpose, x)))(x).dtype == np.float32


def test_vmap_is_every_member_alone(grid):
    matrix, transpose = pair(random_blocks(*grid))
    x = vectors(2, 4, grid[1], N, 3)
    product = lambda x: multiply(matrix, transpose, x)  # noqa: E731
    want = np.stack([[product(x[a, b]) for b in range(4)] for a in range(2)])
    np.testing.assert_allclose(jax.vmap(jax.vmap(product))(x), want, atol=EXACT)
    inner = jax.vmap(product, in_axes=-1, out_axes=-1)(jnp.moveaxis(x[0], 0, -1))
    np.testing.assert_allclose(jnp.moveaxis(inner, -1, 0), want[0], atol=EXACT)
    assert jax.vmap(product)(x[0, :0]).shape == (0, *want.shape[2:])


def test_derivatives_are_products_with_the_transpose(grid):
    matrix, transpose = pair(random_blocks(*grid))
    x, y = vectors(grid[1], N, 1), vectors(grid[0], N, 1)
    product = lambda x: multiply(matrix, transpose, x)  # noqa: E731
    _, pull = jax.vjp(product, x)
    np.testing.assert_allclose(pull(y)[0], multiply(transpose, matrix, y), atol=EXACT)
    _, tangent = jax.jvp(product, (x,), (2.0 * x,))
    np.testing.assert_allclose(tangent, 2.0 * product(x), atol=EXACT)


def test_derivatives_pass_through_scan_and_checkpoint():
    blocks = random_blocks(3, 1)
    matrix, transpose = pair(blocks)
    whole, x = dense(blocks)[:, 0], vectors(1, N, 2)

    def through(product):
        @jax.checkpoint
        def step(x, _):
            return jnp.sin(0.1 * product(x)), None

        return jax.grad(lambda x: jnp.sum(jax.lax.scan(step, x, length=3)[0]))

    found = through(lambda x: multiply(transpose, matrix, multiply(matrix, transpose, x)))(x)
    want = through(lambda x: jnp.einsum("ikl,ikm,jmb->jlb", whole, whole, x))(x)
    np.testing.assert_allclose(found, want, rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("grid", [(1, 1), (1, 2)])
def test_derivatives_to_the_entries_by_differences(grid):
    """Forward and reverse mode, first and second order, to the entries and the vector at once."""
    build, numbers = of_entries(*grid)
    at = 0.2 * numbers, vectors(grid[1], N, 2)
    way = vectors(*at[0].shape), vectors(*at[1].shape)[::-1]

    @jax.jit
    def f(at):
        matrix, transpose = build(at[0])
        y = jnp.sin(multiply(matrix, transpose, at[1]))
        return jnp.sum(multiply(transpose, matrix, y) ** 2)

    def along(f):
        return lambda at: jax.jvp(f, (at,), (way,))[1]

    def difference(f, h=1e-5):
        more, less = (jax.tree.map(lambda x, d, s=s: x + s * d, at, way) for s in (h, -h))
        return jax.tree.map(lambda a, b: (a - b) / (2.0 * h), f(more), f(less))

    def slope_at(at):
        return sum(jnp.sum(g * d) for g, d in zip(jax.grad(f)(at), way, strict=True))

    gradient = jax.jit(jax.grad(f))
    forward = jax.jit(along(f))
    slope = jax.jit(slope_at)(at)
    np.testing.assert_allclose(slope, difference(f), rtol=FD)
    np.testing.assert_allclose(forward(at), slope, rtol=EXACT)
    bent = difference(gradient)
    for second in (along(gradient), jax.grad(along(f)), jax.grad(slope_at)):
        for found, want in zip(jax.jit(second)(at), bent, strict=True):
            np.testing.assert_allclose(found, want, rtol=FD, atol=FD * jnp.abs(want).max())
    np.testing.assert_allclose(jax.jit(along(along(f)))(at), difference(forward), rtol=FD)


def test_vmap_over_matrices_of_one_pattern(grid):
    build, numbers = of_entries(*grid)
    many = numbers[None] * jnp.array([[1.0], [2.0], [-0.5]])
    x = vectors(3, grid[1], N, 2)

    def f(numbers, x):
        return jnp.sum(jnp.sin(multiply(*build(numbers), x)))

    gradient = jax.grad(f, (0, 1))
    alone = jax.jit(gradient)
    for axis, vector in ((0, x), (None, x[0])):
        found = jax.jit(jax.vmap(gradient, (0, axis)))(many, vector)
        for k in range(3):
            want = alone(many[k], vector if axis is None else vector[k])
            for part in range(2):
                np.testing.assert_allclose(found[part][k], want[part], atol=EXACT)


def operations(function, *arguments) -> dict[str, int]:
    text = jax.jit(function).lower(*arguments).compile().as_text()
    names = ("gather", "scatter", "concatenate", "pad", "copy", "transpose", "dynamic-slice")
    return {name: len(re.findall(rf" {name}\(", text)) for name in names}


def test_the_padding_leaves_no_trace_in_the_program(grid):
    """Value, gradient and vmap are the bare products: as many gathers, copies and so on."""
    matrix, transpose = pair(random_blocks(*grid))
    x = vectors(grid[1], N, 2)
    bare = ell._product
    value = lambda m, t, x: jnp.sum(jnp.sin(multiply(m, t, x)))  # noqa: E731
    gradient = lambda m, t, x: bare(t, jnp.cos(bare(m, x)))  # noqa: E731
    want = operations(gradient, matrix, transpose, x)
    assert want["gather"] > 0
    assert operations(jax.grad(value, 2), matrix, transpose, x) == want
    want = operations(lambda m, t, x: bare(m, x), matrix, transpose, x)
    assert operations(multiply, matrix, transpose, x) == want
    many = jnp.stack([x] * 4)
    alone = operations(gradient, matrix, transpose, x)
    found = operations(jax.vmap(jax.grad(value, 2), (None, None, 0)), matrix, transpose, many)
    assert {k: found[k] for k in ("gather", "scatter", "pad")} == {
        k: alone[k] for k in ("gather", "scatter", "pad")
    }


def test_blocks_of_other_patterns_go_together():
    """Also where both have the same columns in other rows."""
    first = sp.csr_matrix(np.array([[1.0, 2.0], [0.0, 0.0]]))
    second = sp.csr_matrix(np.array([[3.0, 0.0], [0.0, 4.0]]))
    blocks = [[first], [second]]
    matrix, transpose = pair(blocks)
    x = vectors(1, 2, 1)
    want = np.einsum("ijkl,jlb->ikb", dense(blocks), x)
    np.testing.assert_allclose(multiply(matrix, transpose, x), want, atol=EXACT)
