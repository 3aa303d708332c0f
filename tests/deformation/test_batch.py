"""Batches: every member as if alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TWENTY, relative

import jaxdeform as jd
from jaxdeform._linalg import lbfgs


@pytest.mark.slow
def test_vmap_over_targets_rigidity_and_start(bar, bar_problem, bar_targets):
    targets = jnp.stack([jnp.asarray(bar_targets), jnp.asarray(bar_targets) + 3.0])
    lam = jnp.asarray([0.1, 10.0])
    start = jnp.stack([jnp.asarray(bar.vertices)] * 2)

    def one(t, r, s):
        return jd.deform(bar_problem, t, r, start=s, solver=TWENTY).vertices

    batch = jax.jit(jax.vmap(one))(targets, lam, start)
    for k in range(2):
        assert relative(batch[k], one(targets[k], lam[k], start[k])) < 1e-9
    mixed = jax.vmap(lambda r: jd.deform(bar_problem, bar_targets, r).vertices)(lam)
    for k in range(2):
        assert relative(mixed[k], jd.deform(bar_problem, bar_targets, lam[k]).vertices) < 1e-6


@pytest.mark.slow
def test_queue_of_lanes_is_every_lane_alone(bar, bar_problem, bar_targets):
    """More lanes than iterate together, of unlike lengths, one of them broken; nested vmap too."""
    lam = np.geomspace(0.01, 100.0, 2 * lbfgs.SLOTS + 5)

    def one(r):
        return jd.deform(bar_problem, bar_targets, r)

    single = jax.jit(one)
    want = [single(r) for r in lam]
    broken = len(lam) // 3
    rigidity = lam.copy()
    rigidity[broken] = np.nan  # only a traced number can be one: others are refused
    got = jax.jit(jax.vmap(one))(rigidity)
    for k, alone in enumerate(want):
        if k == broken:
            assert bool((got.result == jd.Result.bad_input)[k])
            continue
        np.testing.assert_allclose(got.vertices[k], alone.vertices, atol=1e-4)
        assert abs(int(got.steps[k]) - int(alone.steps)) <= 2  # sums are in another order
        energy = np.asarray(got.energy[k])
        np.testing.assert_allclose(energy[-1], alone.energy[-1], rtol=1e-7)
        steps = int(got.steps[k])
        np.testing.assert_array_equal(energy[steps:], energy[-1])
        assert np.all(np.diff(energy) <= 1e-9 * np.abs(energy[:-1]))
    assert jax.vmap(one)(jnp.zeros(0)).vertices.shape == (0, *bar.vertices.shape)
    nested = jax.jit(jax.vmap(jax.vmap(one)))(jnp.asarray(lam[:6]).reshape(2, 3))
    np.testing.assert_allclose(
        nested.vertices.reshape(6, *bar.vertices.shape), got.vertices[:6], atol=1e-4
    )
