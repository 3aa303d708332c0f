"""Intervals and verdicts by themselves, on a linear model whose intervals are known."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import EXACT

import jaxdeform as jd
from jaxdeform._estimation.deformed import PoseDerivatives
from jaxdeform._estimation.intervals import has_settled, log_intervals, profile_cost
from jaxdeform._estimation.noise import HandleNoise
from jaxdeform._estimation.part_model import PartModel
from jaxdeform._estimation.poses import Poses
from jaxdeform._estimation.spectrum import Spread
from jaxdeform._estimation.verdict import in_words

POSES = 20


class LinearModel(PartModel):
    """Vertices that move in proportion to log rigidity: ``slopes @ theta``."""

    slopes: np.ndarray

    def fit(self, theta, noise):
        vertices = self.slopes @ theta
        counted = self.poses.counted[..., None]
        residual = np.where(counted, vertices - self.poses.observed, 0.0)
        jacobian = np.where(counted[..., None], self.slopes, 0.0)
        found = PoseDerivatives(vertices, jacobian, residual, np.zeros_like(residual), [])
        return self.weighted(theta, found, noise)


@pytest.fixture(scope="module")
def problem() -> jd.Problem:
    return jd.precompute(jd.shapes.square(), [0, 1, 2, 6, 7, 8])


def linear_model(problem, influence) -> LinearModel:
    """Return a model with so much influence of each of two parts, and noise of size 0.01."""
    draw = np.random.default_rng(0)
    free = np.broadcast_to(np.asarray(problem.system.free)[:9], (POSES, 9))
    slopes = draw.standard_normal((POSES, 9, 3, 2)) * influence
    observed = slopes @ np.zeros(2) + 0.01 * draw.standard_normal((POSES, 9, 3))
    observed = np.where(free[..., None], observed, 0.0)
    poses = Poses(np.zeros((POSES, 6, 3)), observed, free, observed)
    label = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1])
    model = LinearModel.build(problem, poses, label, jd.QuasiNewton(), jd.Implicit())
    model = replace(model, size=np.ones(2))
    object.__setattr__(model, "slopes", slopes)
    return model


def best_fit(model: LinearModel):
    """Return the fit at the least-squares solution, and the classical spread of 95 %."""
    counted = model.poses.counted
    slopes, seen = model.slopes[counted].reshape(-1, 2), model.poses.observed[counted].ravel()
    theta, (cost,), *_ = np.linalg.lstsq(slopes, seen)
    inverse = np.diag(np.linalg.inv(slopes.T @ slopes))
    widths = 1.959964 * np.sqrt(cost / (len(seen) - 2) * inverse)
    return model.fit(theta, HandleNoise.none(model.poses)), Spread(widths, inverse)


def test_a_narrow_interval_is_that_of_the_linear_model(problem):
    model = linear_model(problem, [1.0, 0.1])
    best, classical = best_fit(model)
    ends = log_intervals(model, best, classical)
    expected = best.theta[:, None] + np.outer(classical.half_width, [-1, 1])
    np.testing.assert_allclose(ends, expected, rtol=EXACT)


def test_the_profile_fits_the_other_part_anew(problem):
    """A linear model's profile is the parabola of the inverse's diagonal."""
    model = linear_model(problem, [1.0, 0.1])
    best, classical = best_fit(model)
    for part, move in ((0, 0.3), (1, -2.0)):
        cost = profile_cost(model, best, part, best.theta[part] + move)
        expected = best.cost + move**2 / classical.inverse[part]
        np.testing.assert_allclose(cost, expected, rtol=1e-8)


def test_a_wide_interval_is_followed_to_both_ends(problem):
    model = linear_model(problem, [1.0, 1e-3])
    best, classical = best_fit(model)
    assert classical.half_width[1] > 0.5
    ends = log_intervals(model, best, classical)[1]
    off = ends - best.theta[1] - classical.half_width[1] * np.array([-1, 1])
    assert np.abs(off).max() < 0.05  # as promised


@pytest.mark.parametrize("influence", [1e-9, 1e-7])
def test_a_part_without_influence_has_no_ends(problem, influence):
    model = linear_model(problem, [1.0, influence])
    best, classical = best_fit(model)
    best = model.fit(np.array([best.theta[0], 0.0]), best.noise)
    ends = log_intervals(model, best, classical)
    assert ends[1].tolist() == [-np.inf, np.inf]
    np.testing.assert_allclose(ends[0, 1] - ends[0, 0], 2 * classical.half_width[0], rtol=0.05)


def test_a_search_that_stopped_early_has_not_settled(problem):
    model = linear_model(problem, [1.0, 0.1])
    best, classical = best_fit(model)
    assert has_settled(model, best, classical)
    for part in range(2):
        theta = best.theta.copy()
        theta[part] += classical.half_width[part]
        assert not has_settled(model, model.fit(theta, best.noise), classical)


V = jd.Verdict


@pytest.mark.parametrize(
    ("interval", "factor", "expected", "words"),
    [
        ((0.5, 2.0), 10.0, V.determined, "1 (0.5 to 2)"),
        ((0.5, 2.0), 1.5, V.not_determined, "not determined by these poses"),
        ((0.9, 2.0), 1.5, V.at_least, "at least 0.9"),
        ((0.5, np.inf), 10.0, V.at_least, "at least 0.5"),
        ((1e-3, np.inf), 10.0, V.at_least, "at least 0.001"),
        ((0.0, 1e3), 10.0, V.at_most, "at most 1e+03"),
        ((1e-3, 1e3), 10.0, V.not_determined, "not determined by these poses"),
        ((0.01, 2.0), 10.0, V.at_most, "at most 2"),
        ((0.0, 2.0), 10.0, V.at_most, "at most 2"),
        ((0.0, np.inf), 10.0, V.not_determined, "not determined by these poses"),
    ],
)
def test_verdicts_follow_from_the_interval(interval, factor, expected, words):
    verdict = V.of(1.0, np.array(interval), factor)
    assert verdict is expected
    assert in_words(verdict, 1.0, np.array(interval)) == words


def test_the_search_needs_only_the_triangle(problem):
    """The QR decomposition keeps cost, gradient and curvature of the whole residual."""
    model = linear_model(problem, [1.0, 0.1])
    fit = model.fit(np.array([0.3, -0.2]), HandleNoise.none(model.poses))
    jacobian = fit.jacobian.reshape(-1, 2)
    np.testing.assert_allclose(fit.normal, jacobian.T @ jacobian, rtol=EXACT)
    np.testing.assert_allclose(fit.cost, np.sum(fit.residual**2), rtol=EXACT)
    small = fit.evaluation
    np.testing.assert_allclose(
        small.jacobian.as_matrix().T @ small.residual, jacobian.T @ fit.residual.ravel(), rtol=EXACT
    )
