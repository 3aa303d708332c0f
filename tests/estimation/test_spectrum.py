"""Intervals and the F test on linear problems, where the truth is known."""

import numpy as np
import pytest
from helpers import EXACT, bumpy_sheet
from scipy import stats

from jaxdeform._estimation.discrepancy import LEVEL, describe, f_test
from jaxdeform._estimation.outliers import MANY, find_outliers
from jaxdeform._estimation.smooth_modes import smooth_modes
from jaxdeform._estimation.spectrum import spread

SIDE = 9
POINTS = np.stack(np.meshgrid(*[np.arange(float(SIDE))] * 2, [0.0, 1.0]), -1).reshape(-1, 3)
N, DIAGONAL = len(POINTS), float(np.linalg.norm(np.ptp(POINTS, axis=0)))
ALL = np.ones((1, N), bool)
MODES = smooth_modes(POINTS, ALL, DIAGONAL)
# How two rigidities move the points: smoothly, as rigidities do.
SLOPES = np.stack(
    [
        np.stack([np.sin(POINTS[:, 0] / 3), 0.1 * POINTS[:, 1], POINTS[:, 0] ** 2 / 40], -1),
        np.stack([0.05 * POINTS[:, 0], np.cos(POINTS[:, 1] / 2), 0.2 * POINTS[:, 2]], -1),
    ],
    -1,
)[None]
MATRIX = SLOPES.reshape(-1, 2)
NONE = np.zeros((1, N, 3, 0))


def smooth_noise(draw, length):
    """Return a smooth random displacement of the points (a Gaussian process)."""
    distance = np.linalg.norm(POINTS[:, None] - POINTS[None], axis=-1)
    kernel = np.exp(-0.5 * (distance / (length * DIAGONAL)) ** 2) + 1e-9 * np.eye(N)
    return np.linalg.cholesky(kernel) @ draw.standard_normal((N, 3))


def fitted(noise):
    """Return the error of least squares and the residual that it leaves."""
    error = np.linalg.lstsq(MATRIX, noise.ravel(), rcond=None)[0]
    return error, (noise.ravel() - MATRIX @ error).reshape(1, N, 3)


def coverage(noise_of, draws) -> np.ndarray:
    """Return how often the interval contains 0, the truth, for each part."""
    hits = np.zeros(2)
    for seed in range(draws):
        error, residual = fitted(noise_of(np.random.default_rng(seed)))
        hits += np.abs(error) <= spread(SLOPES, residual, MODES, 3 * N, 1e-12, NONE).half_width
    return hits / draws


def test_the_patterns_are_orthonormal_and_smooth_ones_first():
    inner = MODES[0].T @ MODES[0]
    np.testing.assert_allclose(inner, np.eye(len(inner)), atol=EXACT)
    near = np.linalg.norm(POINTS[:, None] - POINTS[None], axis=-1) == 1.0
    a, b = np.nonzero(near)
    rough = np.sum((MODES[0][a] - MODES[0][b]) ** 2, axis=0)
    assert rough[:3].max() < 0.2 * rough[-3:].min()


def test_patterns_of_vertices_that_were_not_seen_are_zero():
    seen = np.random.default_rng(0).random((2, N)) < 0.7
    modes = smooth_modes(POINTS, seen, DIAGONAL)
    for pose, mask in enumerate(seen):
        assert not modes[pose][~mask].any()
        inner = modes[pose].T @ modes[pose]
        np.testing.assert_allclose(inner, np.eye(len(inner)), atol=EXACT)


def test_many_points_are_sampled():
    """The patterns of 900 points from 300 of them: nearly the eigenvectors of all."""
    points = np.random.default_rng(0).random((900, 3)) * [4.0, 1.0, 1.0]
    modes = smooth_modes(points, np.ones((1, 900), bool), 4.0)[0]
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    exact = np.linalg.eigh(np.exp(-distance / 2.0))[1][:, ::-1][:, :8]
    kept = np.linalg.norm(modes.T @ exact, axis=0)
    assert kept.min() > 0.999


@pytest.mark.slow
def test_independent_noise_is_covered_as_often_as_promised():
    """800 draws: 95 % to within three standard errors, 0.023; and hardly wider than it must be."""
    found = coverage(lambda draw: draw.standard_normal((N, 3)), 800)
    assert (np.abs(found - 0.95) < 0.025).all()


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.1, 0.3, 1.0])
def test_smooth_errors_are_covered_where_the_textbook_fails(length):
    """A wrong model leaves such a residual. 400 draws; the docs promise 0.9."""
    assert coverage(lambda draw: smooth_noise(draw, length), 400).min() > 0.88
    inverse = np.sqrt(np.diag(np.linalg.inv(MATRIX.T @ MATRIX)))
    hits = np.zeros(2)
    for seed in range(100):
        error, residual = fitted(smooth_noise(np.random.default_rng(seed), length))
        hits += np.abs(error) <= 1.96 * inverse * np.sqrt(np.sum(residual**2) / (3 * N - 2))
    assert hits.max() < 70


def test_independent_noise_gives_nearly_the_textbooks_interval():
    inverse = np.sqrt(np.diag(np.linalg.inv(MATRIX.T @ MATRIX)))
    ratios = []
    for seed in range(40):
        _, residual = fitted(np.random.default_rng(seed).standard_normal((N, 3)))
        textbook = 1.96 * inverse * np.sqrt(np.sum(residual**2) / (3 * N - 2))
        ratios.append(spread(SLOPES, residual, MODES, 3 * N, 1e-12, NONE).half_width / textbook)
    assert 0.9 < np.median(ratios) < 1.4


def test_two_poses_halve_the_variance():
    slopes, modes = np.concatenate([SLOPES, SLOPES]), np.concatenate([MODES, MODES])
    ratios = []
    for seed in range(40):
        noise = np.random.default_rng(seed).standard_normal((2, N, 3))
        error = np.linalg.lstsq(slopes.reshape(-1, 2), noise.ravel(), rcond=None)[0]
        both = spread(slopes, noise - slopes @ error, modes, 6 * N, 1e-12, np.zeros((2, N, 3, 0)))
        one = spread(SLOPES, fitted(noise[0])[1], MODES, 3 * N, 1e-12, NONE)
        ratios.append(both.half_width / one.half_width)
        np.testing.assert_allclose(both.inverse, 0.5 * one.inverse, rtol=1e-8)
    # A little less than the root of 0.5, because Student's t knows its variance better.
    assert 0.55 < np.median(ratios) < 0.75


def test_free_directions_widen_the_interval():
    """A direction along the first slope, fitted too, takes away all that is known of that part."""
    _, residual = fitted(np.random.default_rng(0).standard_normal((N, 3)))
    plain = spread(SLOPES, residual, MODES, 3 * N, 1e-12, NONE)
    mix = SLOPES[0, ..., 0] + 0.1 * np.random.default_rng(1).standard_normal((N, 3))
    free = (mix / np.linalg.norm(mix))[None, ..., None]
    away = lambda x: x - free[..., 0] * np.sum(free[..., 0] * x)  # noqa: E731
    slopes = np.stack([away(SLOPES[..., k]) for k in range(2)], -1)
    wide = spread(slopes, away(residual), MODES, 3 * N, 1e-12, free)
    assert wide.half_width[0] > 3.0 * plain.half_width[0]


# ---------------------------------------------------------------- the F test


def test_the_f_test_is_exact_for_independent_noise():
    """Its p values are uniform: Kolmogorov and Smirnov over 400 draws."""
    values = []
    for seed in range(400):
        _, residual = fitted(np.random.default_rng(seed).standard_normal((N, 3)))
        values.append(f_test(SLOPES, residual, MODES, 3 * N))
    assert stats.kstest(values, "uniform").pvalue > 0.01


def test_the_f_test_finds_a_smooth_part_below_the_noise():
    found = 0
    for seed in range(20):
        draw = np.random.default_rng(seed)
        noise = draw.standard_normal((N, 3)) + 0.5 * smooth_noise(draw, 0.3)
        found += f_test(SLOPES, fitted(noise)[1], MODES, 3 * N) < LEVEL
    assert found >= 18


def test_the_size_of_the_smooth_part_is_told():
    draw = np.random.default_rng(0)
    warp = smooth_noise(draw, 0.3)
    warp = warp / np.sqrt(np.mean(warp**2))
    residual = (0.01 * warp + 0.001 * draw.standard_normal((N, 3)))[None]
    said = describe(residual, MODES, 3 * N, 1e-9, DIAGONAL, 0.1)
    assert said.found
    np.testing.assert_allclose(said.size, 0.01, rtol=0.05)
    np.testing.assert_allclose(said.relative, said.size / DIAGONAL, rtol=EXACT)
    np.testing.assert_allclose(said.share, 0.1, rtol=0.05)
    worst = np.linalg.norm(warp, axis=1)
    assert worst[said.vertex] > 0.9 * worst.max()
    assert f"vertex {said.vertex}" in said.explain()


# ---------------------------------------------------------------- outliers


def test_outliers_are_found_in_noise_and_smooth_errors():
    mesh = bumpy_sheet()
    draw = np.random.default_rng(0)
    smooth = np.sin(mesh.vertices / 3.0)
    for error in (0.0, 0.05):
        residual = error * smooth + 1e-3 * draw.standard_normal((56, 3))
        residual[[10, 33]] += 1.0
        found = find_outliers(mesh.edges, residual[None], np.ones((1, 56), bool), 1e-6)
        assert np.flatnonzero(found[0]).tolist() == [10, 33]


def test_what_is_wrong_everywhere_is_too_much():
    mesh = bumpy_sheet()
    residual = np.random.default_rng(0).standard_cauchy((1, 56, 3))
    assert find_outliers(mesh.edges, residual, np.ones((1, 56), bool), 1e-6).mean() > MANY


def test_deviations_below_the_floor_are_none():
    mesh = bumpy_sheet()
    residual = np.zeros((1, 56, 3))
    residual[0, 10] = 1e-5
    counted = np.ones((1, 56), bool)
    assert not find_outliers(mesh.edges, residual, counted, 1e-4).any()
    assert find_outliers(mesh.edges, residual, counted, 1e-6)[0, 10]
