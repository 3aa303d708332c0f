"""Sizes of arrays: a short series, little waste, and the first entries are the array's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from jaxdeform._linalg.buckets import bucket, cut, enlarge, fill_up, next_of

COUNTS = np.unique(np.geomspace(1, 3_000_000, 20_000).astype(int))


def test_buckets_are_few_and_waste_little():
    sizes = np.array([bucket(int(n)) for n in COUNTS])
    assert (sizes >= COUNTS).all()
    assert (np.diff(sizes) >= 0).all()
    octaves = np.log2(COUNTS[-1] / 64)
    assert len(set(sizes)) <= 4 * octaves + 2
    waste = (sizes / COUNTS - 1.0)[COUNTS > 64]
    assert waste.max() < 0.26
    assert waste.mean() < 0.12


def test_a_bucket_is_its_own():
    assert all(bucket(size) == size for size in {bucket(int(n)) for n in COUNTS})


def test_rows_do_not_collide_in_the_cache():
    assert all(bucket(int(n)) * 8 % 4096 for n in COUNTS)


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("dtype", [bool, np.int32, np.float32, np.float64])
def test_filling_up_keeps_what_is_there(xp, dtype):
    given = xp.asarray(np.arange(6).reshape(2, 3).astype(dtype))
    for found in (fill_up(given, 5, 1.0), jax.jit(lambda x: fill_up(x, 5, 1.0))(given)):
        assert found.dtype == given.dtype
        np.testing.assert_array_equal(found, [[*row, 1, 1] for row in np.asarray(given)])
    assert fill_up(given, 3) is given


def test_cutting_undoes_filling_up():
    given = np.arange(24.0).reshape(2, 3, 4)
    for axis in (0, 1, -1, -2):
        full = jnp.moveaxis(fill_up(jnp.moveaxis(jnp.asarray(given), axis, -1), 8), -1, axis)
        np.testing.assert_array_equal(cut(full, given.shape[axis], axis), given)
        inside = jax.jit(lambda x, axis=axis: cut(x, given.shape[axis], axis))(full)
        np.testing.assert_array_equal(inside, given)


def test_enlarging_adds_empty_rows_and_columns():
    given = sp.csc_matrix(np.random.default_rng(0).integers(0, 2, (5, 5)).astype(float))
    found = enlarge(given, 7)
    np.testing.assert_array_equal(found.toarray(), np.pad(given.toarray(), (0, 2)))
    assert given.shape == (5, 5)


def test_series_go_on_by_doubling():
    assert [next_of((2.0, 3.0), x) for x in (0.0, 2.0, 2.1, 3.5, 6.1)] == [2, 2, 3, 6, 12]
