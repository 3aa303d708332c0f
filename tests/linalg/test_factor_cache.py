"""The cache of factors: one for each matrix, in bounded memory."""

import gc
import threading

import jax.numpy as jnp
import pytest
from factors import DOUBLE, graded, made, solve

from jaxdeform._linalg import factor_cache
from jaxdeform._linalg.factor_cache import FactorCache, Matrix, NotPositiveDefinite


@pytest.fixture
def matrices():
    """Keys and matrices, all of the same size."""
    contents = [Matrix.of(*graded(seed=k)) for k in range(8)]
    return [(content.key(), content) for content in contents]


def made_in(monkeypatch) -> list[int]:
    """Return a list that grows by one at each factorisation."""
    count, inner = [], factor_cache.cholesky

    def counted(*arguments):
        count.append(1)
        return inner(*arguments)

    monkeypatch.setattr(factor_cache, "cholesky", counted)
    return count


def test_eight_threads_make_one_factor_of_a_matrix(monkeypatch, matrices):
    count = made_in(monkeypatch)
    cache, gate, found = FactorCache(1 << 30), threading.Barrier(8), []

    def ask():
        gate.wait()
        found.append([cache.get(*pair, DOUBLE) for pair in matrices[:3]])

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(count) == 3
    assert all(a is b for one in found for a, b in zip(one, found[0], strict=True))


def test_a_failure_is_told_to_all_and_not_kept(matrices):
    cache = FactorCache(1 << 30)
    matrix, free = graded()
    content = Matrix.of(-matrix, free)
    for _ in range(2):
        with pytest.raises(NotPositiveDefinite):
            cache.get(content.key(), content, DOUBLE)
    cache.get(*matrices[0], DOUBLE)


def test_memory_is_bounded(monkeypatch, matrices):
    count = made_in(monkeypatch)
    cache = FactorCache(1 << 30)
    cache.get(*matrices[0], DOUBLE)
    cache.capacity = int(2.5 * cache.size)
    for k in (1, 0, 2):  # 1 is the one not used for longest when 2 is made
        cache.get(*matrices[k], DOUBLE)
    assert len(count) == 3
    cache.get(*matrices[0], DOUBLE)
    assert len(count) == 3
    cache.get(*matrices[1], DOUBLE)
    assert len(count) == 4
    assert cache.size <= cache.capacity
    cache.capacity = 1  # the one just made stays in any case
    for pair in matrices:
        made_now = cache.get(*pair, DOUBLE)
        assert cache.get(*pair, DOUBLE) is made_now


def test_factors_of_collected_owners_go(monkeypatch, matrices):
    count = made_in(monkeypatch)
    monkeypatch.setattr(factor_cache, "_UNOWNED", 0)
    cache = FactorCache(1 << 30)
    owners = [jnp.zeros(3) + k for k in range(8)]
    for pair, owner in zip(matrices, owners, strict=True):
        cache.own(pair[0], owner)
    for pair in matrices[:5]:
        cache.get(*pair, DOUBLE)
    one = cache.size / 5
    twin = jnp.zeros(3)
    cache.own(matrices[0][0], twin)  # a second owner of the first
    del owner, owners[:5]
    gc.collect()
    cache.get(*matrices[5], DOUBLE)
    # The first, the one just made, and the last two without an owner, which may be in use.
    assert round(cache.size / one) == 4
    cache.get(*matrices[0], DOUBLE)
    assert len(count) == 6
    cache.own(matrices[4][0], twin)  # has an owner again
    cache.get(*matrices[6], DOUBLE)
    cache.get(*matrices[4], DOUBLE)
    assert len(count) == 7


def test_a_hundred_factors_made_and_dropped(right):
    factor_cache.factors.clear()
    for k in range(100):
        solve(made(k), right)
    assert factor_cache.factors.size < factor_cache._UNOWNED + (8 << 20)
