"""Members of a batch, side by side: against a loop in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from jaxdeform._linalg.batching import side_by_side
from jaxdeform._linalg.varying import as_varying

RNG = np.random.default_rng(0)
MATRIX = RNG.normal(size=(2, 3, 4, 5))
VECTOR = RNG.normal(size=(2, 3, 5))


def products(shared, own):
    """Return a product for each member, and how many members there are."""
    x, scale = own
    members = jnp.full(len(x), len(x), jnp.int32)
    return jnp.einsum("ij,mj->mi", shared, x) * scale[:, None], members


def one(matrix, x, scale):
    out, members = side_by_side(products, matrix, (x[None], jnp.asarray(scale)[None]))
    return out[0], members[0]


@pytest.mark.parametrize("jit", [False, True])
def test_members_of_nested_vmaps_go_together(jit):
    over = jax.vmap(jax.vmap(one, in_axes=(None, 0, None)), in_axes=(None, 0, 0))
    scale = np.array([2.0, -1.0])
    out, members = (jax.jit(over) if jit else over)(MATRIX[0, 0], VECTOR, scale)
    np.testing.assert_allclose(out, VECTOR @ MATRIX[0, 0].T * scale[:, None, None], rtol=1e-14)
    assert (np.asarray(members) == 6).all()


def test_a_function_may_read_an_array_of_its_own():
    captured = jnp.asarray(VECTOR[0, 0])
    plus = lambda shared, own: own + shared + captured[None]  # noqa: E731
    over = jax.vmap(lambda x: side_by_side(plus, 1.0, x[None])[0])
    expected = VECTOR[0] + 1.0 + VECTOR[0, 0]
    np.testing.assert_allclose(over(VECTOR[0]), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(over)(VECTOR[0]), expected, rtol=1e-14)


def test_what_is_not_shared_goes_one_by_one():
    """The matrix is that of the outer batch, so only the three of the inner one go together."""
    over = jax.vmap(jax.vmap(one, in_axes=(None, 0, None)), in_axes=(0, 0, None))
    out, members = over(MATRIX[:, 0], VECTOR, 1.0)
    np.testing.assert_allclose(out, np.einsum("aij,abj->abi", MATRIX[:, 0], VECTOR), rtol=1e-14)
    assert (np.asarray(members) == 3).all()
    out, members = jax.vmap(jax.vmap(one, in_axes=(0, 0, None)), in_axes=(0, 0, None))(
        MATRIX, VECTOR, 1.0
    )
    np.testing.assert_allclose(out, np.einsum("abij,abj->abi", MATRIX, VECTOR), rtol=1e-14)
    assert (np.asarray(members) == 1).all()


def test_a_loop_that_begins_with_zeros_varies_like_its_input():
    device = jax.make_mesh((1,), ("batch",), axis_types=(AxisType.Auto,))
    part = PartitionSpec("batch")

    def doubled(x):
        begin = as_varying((jnp.zeros(3), jnp.zeros((), jnp.int32)), x)
        add = lambda at: (at[0] + x, at[1] + 1)  # noqa: E731
        return jax.lax.while_loop(lambda at: at[1] < 2, add, begin)[0]

    x = np.arange(3.0)
    np.testing.assert_array_equal(doubled(x), 2 * x)
    apart = jax.shard_map(doubled, mesh=device, in_specs=part, out_specs=part)
    np.testing.assert_array_equal(jax.jit(apart)(x), 2 * x)
