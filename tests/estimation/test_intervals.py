"""Intervals and verdicts by themselves, on a linear model whose intervals are known."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT

import jaxdeform as jd
from jaxdeform._estimation.intervals import (
    curvature,
    log_intervals,
    look_the_same,
    profile_cost,
    verdict,
)
from jaxdeform._estimation.part_model import PartModel
from jaxdeform._estimation.poses import PoseDerivatives, Poses

POSES = 20


class LinearModel(PartModel):
    """Vertices that move in proportion to log rigidity: ``slopes @ theta``."""

    slopes: np.ndarray

    def fit(self, theta, modes):
        vertices = self.slopes @ theta
        counted = self.poses.counted[..., None]
        residual = np.where(counted, vertices - self.poses.observed, 0.0)
        jacobian = np.where(counted[..., None], self.slopes, 0.0)
        return self.weighted(
            theta, PoseDerivatives(*map(jnp.asarray, (vertices, jacobian, residual))), modes
        )


@pytest.fixture(scope="module")
def problem() -> jd.Problem:
    return jd.precompute(jd.shapes.square(), [0, 1, 2, 6, 7, 8])


def linear_model(problem, influence) -> LinearModel:
    """Return a model with so much influence of each of two parts, and noise of size 0.01."""
    draw = np.random.default_rng(0)
    free = np.broadcast_to(np.asarray(problem.system.free), (POSES, 9))
    slopes = draw.standard_normal((POSES, 9, 3, 2)) * influence
    observed = slopes @ np.zeros(2) + 0.01 * draw.standard_normal((POSES, 9, 3))
    poses = Poses(np.zeros((POSES, 6, 3)), np.where(free[..., None], observed, 0.0), free)
    label = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1])
    model = LinearModel.build(problem, poses, label, jd.QuasiNewton(), jd.Implicit())
    model = replace(model, size=np.ones(2))
    object.__setattr__(model, "slopes", slopes)
    return model


def best_fit(model: LinearModel):
    """Return the fit at the least-squares solution, and the classical half-widths of 95 %."""
    counted = model.poses.counted
    slopes, seen = model.slopes[counted].reshape(-1, 2), model.poses.observed[counted].ravel()
    theta, (cost,), *_ = np.linalg.lstsq(slopes, seen)
    variance = cost / (len(seen) - 2)
    widths = 1.959964 * np.sqrt(variance * np.diag(np.linalg.inv(slopes.T @ slopes)))
    return model.fit(theta, None), widths


def test_curvature_gives_the_classical_interval(problem):
    model = linear_model(problem, [1.0, 0.1])
    best, widths = best_fit(model)
    linear = curvature(model, best, None)
    np.testing.assert_allclose(linear.deviation, widths, rtol=1e-8)  # a ridge of 1e-16 tr(J^T J)
    ends = log_intervals(model, best, None)
    np.testing.assert_allclose(ends, best.theta[:, None] + np.outer(widths, [-1, 1]), rtol=1e-8)


def test_the_profile_fits_the_other_part_anew(problem):
    """A linear model's profile is the parabola of the inverse's diagonal."""
    model = linear_model(problem, [1.0, 0.1])
    best, _ = best_fit(model)
    inverse = np.diag(np.linalg.inv(best.normal))
    for part, move in ((0, 0.3), (1, -2.0)):
        cost = profile_cost(model, best, None, part, best.theta[part] + move)
        np.testing.assert_allclose(cost, best.cost + move**2 / inverse[part], rtol=1e-8)


def test_a_wide_interval_is_followed_to_both_ends(problem):
    model = linear_model(problem, [1.0, 1e-3])
    best, widths = best_fit(model)
    assert widths[1] > 0.5
    ends = log_intervals(model, best, None)[1]
    assert np.abs(ends - best.theta[1] - widths[1] * np.array([-1, 1])).max() < 0.05  # as promised


@pytest.mark.parametrize("influence", [0.0, 1e-9, 1e-7])
def test_a_part_without_influence_has_no_ends(problem, influence):
    model = linear_model(problem, [1.0, influence])
    best, widths = best_fit(linear_model(problem, [1.0, 1.0]))
    best = model.fit(best.theta, None)
    ends = log_intervals(model, best, None)
    assert ends[1].tolist() == [-np.inf, np.inf]
    np.testing.assert_allclose(ends[0, 1] - ends[0, 0], 2 * widths[0], rtol=0.05)


def test_what_looks_the_same_is_a_matter_of_the_tolerance(problem):
    """From 1 a part goes down by ln 1e7 = 16.1 and up by ln 1e5 = 11.5."""
    model = linear_model(problem, [1e-2, 1e-4])
    fit = model.fit(np.zeros(2), None)
    farthest = np.linalg.norm(model.slopes[model.poses.counted], axis=1).max(axis=0)
    moved = farthest[:, None] * np.log([1e7, 1e5])
    for tolerance in (0.5 * moved.min(), 0.5 * moved.max(), moved[0].mean(), 2.0 * moved.max()):
        np.testing.assert_array_equal(look_the_same(model, fit, tolerance), moved <= tolerance)


@pytest.mark.parametrize(
    ("interval", "same", "expected"),
    [
        ((0.5, 2.0), (False, False), "determined"),
        ((0.5, 2.0), (False, True), "at least 0.5"),
        ((0.5, np.inf), (False, False), "at least 0.5"),
        ((0.0, 2.0), (False, False), "at most 2"),
        ((0.5, 2.0), (True, False), "at most 2"),
        ((0.0, np.inf), (False, False), "not determined by these poses"),
        ((0.5, 2.0), (True, True), "not determined by these poses"),
    ],
)
def test_verdicts(interval, same, expected):
    assert verdict(np.array(interval), np.array(same)) == expected


def test_the_search_needs_only_the_triangle(problem):
    """The QR decomposition keeps cost, gradient and curvature of the whole residual."""
    model = linear_model(problem, [1.0, 0.1])
    fit = model.fit(np.array([0.3, -0.2]), None)
    jacobian = fit.jacobian.reshape(-1, 2)
    np.testing.assert_allclose(fit.normal, jacobian.T @ jacobian, rtol=EXACT)
    np.testing.assert_allclose(fit.cost, np.sum(fit.residual**2), rtol=EXACT)
    small = fit.evaluation
    np.testing.assert_allclose(
        small.jacobian.as_matrix().T @ small.residual, jacobian.T @ fit.residual.ravel(), rtol=EXACT
    )
