"""Derivatives and covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, THESIS

import jaxdeform as jd
from jaxdeform._estimation import noise as noise_module
from jaxdeform._estimation.deformed import State, deform_all
from jaxdeform._estimation.noise import HandleNoise, find_handle_noise
from jaxdeform._estimation.poses import Poses


@pytest.mark.slow
def test_derivatives_agree_three_ways(bar_problem, bar_targets, halves):
    """Finite differences, unrolled, and (where converged) implicit."""
    n = len(halves)
    start = np.asarray(jd.deform(bar_problem, bar_targets, 1.0).vertices)[None]
    poses = Poses(bar_targets[None], np.zeros((1, n, 3)), np.ones((1, n), bool), start)
    theta, h = np.log([0.5, 20.0]), 1e-4

    def run(theta, solver, adjoint):
        return map(np.asarray, deform_all(bar_problem, poses, halves, theta, solver, adjoint)[:2])

    for solver, adjoint in ((THESIS, jd.Unrolled()), (jd.QuasiNewton(1e-13), jd.Implicit())):
        _, jacobian = run(theta, solver, adjoint)
        for k in range(2):
            step = h * np.eye(2)[k]
            more, _ = run(theta + step, solver, adjoint)
            less, _ = run(theta - step, solver, adjoint)
            numeric = (more - less) / (2 * h)
            error = np.linalg.norm(jacobian[..., k] - numeric) / np.linalg.norm(numeric)
            assert error < FD


@pytest.mark.parametrize("size", [0.1, 1.0, 100.0])
def test_whitening_twice_is_the_inverse_covariance(size):
    draw = np.random.default_rng(0)
    modes = size * draw.standard_normal((2, 30, 4))
    columns = draw.standard_normal((2, 30, 3))
    noise = HandleNoise(*np.linalg.svd(modes, full_matrices=False)[:2])
    covariance = np.eye(30) + modes @ np.swapaxes(modes, 1, 2)
    once = noise.whiten(columns)
    np.testing.assert_allclose(noise.whiten(once), np.linalg.solve(covariance, columns), atol=EXACT)
    products = np.swapaxes(columns, 1, 2) @ np.linalg.solve(covariance, columns)
    np.testing.assert_allclose(np.swapaxes(once, 1, 2) @ once, products, atol=EXACT)


def test_unbounded_noise_leaves_nothing_along_its_directions():
    draw = np.random.default_rng(0)
    modes = draw.standard_normal((2, 30, 4))
    noise = HandleNoise(*np.linalg.svd(modes, full_matrices=False)[:2]).unbounded
    columns = noise.whiten(draw.standard_normal((2, 30, 3)))
    np.testing.assert_allclose(np.swapaxes(modes, 1, 2) @ columns, 0.0, atol=EXACT)
    np.testing.assert_allclose(noise.whiten(columns), columns, atol=EXACT)
    assert noise.free.shape == (2, 10, 3, 4)


def test_exact_targets_change_nothing():
    seen = np.zeros((2, 10, 3))
    poses = Poses(np.zeros((2, 4, 3)), seen, np.ones((2, 10), bool), seen)
    columns = np.random.default_rng(0).standard_normal((2, 30, 3))
    noise = HandleNoise.none(poses)
    np.testing.assert_array_equal(noise.whiten(columns), columns)
    assert noise.free.shape == (2, 10, 3, 0)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True])
def test_handle_noise_against_the_dense_covariance(exact, monkeypatch):
    """Four handles have 12 directions, all of which are found, as exactly as systems are solved."""
    if exact:
        monkeypatch.setattr(noise_module, "_FINDING", 1e-10)
        monkeypatch.setattr(noise_module, "_MEASURING", 1e-10)
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [0, 2, 6, 8])
    targets = np.asarray(jd.twist(mesh.vertices[problem.handles], 60.0, along="y"))
    free = np.asarray(problem.system.free)[None, : problem.n_vertices]
    end = jd.deform(problem, targets, 0.3)
    pose = np.asarray(end.vertices)[None]
    poses = Poses(targets[None], np.zeros((1, 9, 3)), free, pose)
    ends, field, solver = [State(end.vertices, end.transforms)], np.full(9, 0.3), jd.QuasiNewton()
    dense = jax.jacrev(
        lambda t: jnp.where(free[0][:, None], jd.deform(problem, t, field).vertices, 0.0)
    )(jnp.asarray(targets))
    dense = np.asarray(dense).reshape(27, 12)
    for relative in (1.0, 0.5):
        noise = find_handle_noise(problem, poses, field, ends, solver, jd.Implicit(), relative)
        found = (noise.basis[0] * noise.size[0] ** 2) @ noise.basis[0].T
        np.testing.assert_allclose(
            found, relative**2 * dense @ dense.T, atol=1e-6 if exact else 1e-3
        )
