"""Derivatives and covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, THESIS

import jaxdeform as jd
from jaxdeform._estimation.noise import handle_modes, sandwich, whiten
from jaxdeform._estimation.poses import Poses, deform_all


@pytest.mark.slow
def test_derivatives_agree_three_ways(bar_problem, bar_targets, halves):
    """Finite differences, unrolled, and (where converged) implicit."""
    n = len(halves)
    poses = Poses(bar_targets[None], np.zeros((1, n, 3)), np.ones((1, n), bool))
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
    covariance = np.eye(30) + modes @ np.swapaxes(modes, 1, 2)
    once = whiten(columns, modes)
    np.testing.assert_allclose(
        whiten(once, modes), np.linalg.solve(covariance, columns), atol=EXACT
    )
    products = np.swapaxes(columns, 1, 2) @ np.linalg.solve(covariance, columns)
    np.testing.assert_allclose(np.swapaxes(once, 1, 2) @ once, products, atol=EXACT)
    assert whiten(columns, None) is columns


@pytest.mark.slow
def test_handle_noise_against_the_dense_covariance():
    """W = (I + U U^T)^-1 is exact where the modes are all; then the sandwich is J^T W J."""
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [0, 2, 6, 8])
    targets = np.asarray(jd.twist(mesh.vertices[problem.handles], 60.0, along="y"))
    free = np.asarray(problem.system.free)[None]
    poses = Poses(targets[None], np.zeros((1, 9, 3)), free)
    field, solver = np.full(9, 0.3), jd.QuasiNewton()
    dense = jax.jacrev(
        lambda t: jnp.where(free[0][:, None], jd.deform(problem, t, field).vertices, 0.0)
    )(jnp.asarray(targets))
    dense = np.asarray(dense).reshape(27, 12)
    covariance = np.eye(27) + dense @ dense.T
    modes = np.asarray(handle_modes(problem, poses, field, solver, jd.Implicit()))
    # As exact as the deformation has converged.
    np.testing.assert_allclose(modes[0] @ modes[0].T, dense @ dense.T, atol=1e-4)
    columns = np.random.default_rng(0).standard_normal((1, 9, 3, 2)) * free[..., None, None]
    flat = columns.reshape(1, 27, 2)
    expected = np.linalg.solve(covariance, flat[0])
    weighted = whiten(whiten(flat, modes), modes)
    np.testing.assert_allclose(weighted[0], expected, atol=1e-4)
    freedom, meat = sandwich(problem, poses, field, columns, modes, solver, jd.Implicit())
    np.testing.assert_allclose(meat, flat[0].T @ expected, rtol=1e-3)
    # tr(W S) is the number of coordinates; Hutchinson's eight probes leave little here.
    assert abs(freedom + 2 - 3 * free.sum()) < 0.5
