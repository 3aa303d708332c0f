"""Poses that the model does not explain, and poses that are none: said, not averaged away."""

import igl
import numpy as np
import pytest
from helpers import NOISE, noisy

import jaxdeform as jd


@pytest.fixture(scope="module")
def pose(equilibrium_of) -> np.ndarray:
    return equilibrium_of(20.0)


# ---------------------------------------------------------------- models that do not fit


def check_it_is_said(fit: jd.Estimate, share: float) -> None:
    """The result, the sentence and the size of the unexplained part."""
    assert not fit.ok
    assert fit.result == jd.Result.unexplained
    assert fit.discrepancy.found
    assert fit.discrepancy.share > share
    assert "does not explain these poses" in fit.explain()
    assert f"vertex {fit.discrepancy.vertex}" in fit.explain()


@pytest.mark.slow
def test_another_neighbourhood_size(bar, bar_problem, bar_targets):
    wide = jd.precompute(bar, bar_problem.handles, cells=jd.rings(bar, 2))
    seen = np.asarray(jd.deform(wide, bar_targets, 5.0).vertices)
    check_it_is_said(jd.estimate_rigidity(bar_problem, seen, targets=bar_targets), 0.02)


@pytest.mark.slow
def test_two_materials_fitted_as_one(bar_problem, bar_targets, equilibrium_of, halves):
    seen = equilibrium_of(np.array([5.0, 50.0])[halves])
    fit = jd.estimate_rigidity(bar_problem, seen, targets=bar_targets)
    check_it_is_said(fit, 0.2)
    # The value stands for a mixture, and the interval reaches from one to the other.
    assert fit.interval[0, 1] / fit.interval[0, 0] > 5.0


@pytest.mark.slow
def test_regions_drawn_at_random(bar_problem, bar_targets, equilibrium_of, halves):
    seen = equilibrium_of(np.array([5.0, 50.0])[halves])
    wrong = np.random.default_rng(0).integers(0, 2, len(halves))
    check_it_is_said(jd.estimate_rigidity(bar_problem, seen, targets=bar_targets, parts=wrong), 0.2)


@pytest.mark.slow
def test_poses_that_are_no_equilibria(bar_problem, bar_targets, pose_of):
    check_it_is_said(jd.estimate_rigidity(bar_problem, pose_of(1.0), targets=bar_targets), 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_a_warp_of_the_scan_is_covered_and_said(bar, bar_problem, bar_targets, pose, known):
    """A smooth error of 0.2 % of the diagonal: the textbook's interval misses each time."""
    warp = 0.002 * bar.diagonal * np.sin(pose[:, [1, 2, 0]] / 30.0)
    seen = noisy(bar, pose + warp, seed=0)
    fit = jd.estimate_rigidity(bar_problem, seen, targets=bar_targets if known else None)
    check_it_is_said(fit, 0.0)
    assert fit.interval[0, 0] <= 20.0 <= fit.interval[0, 1]
    # Observed handles are warped too, and carry a part of it.
    size = 0.002 / np.sqrt(2)
    assert (0.5 if known else 0.2) * size < fit.discrepancy.relative < 1.5 * size


@pytest.mark.slow
def test_right_models_are_not_accused(bar, bar_problem, bar_targets, pose):
    for seed in range(5):
        fit = jd.estimate_rigidity(bar_problem, noisy(bar, pose, seed), targets=bar_targets)
        assert fit.ok
        assert not fit.discrepancy.found
        np.testing.assert_allclose(fit.relative_misfit, NOISE, rtol=0.1)


# ---------------------------------------------------------------- what is no pose


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda pose: 1000.0 * pose, "997 times as long as at rest"),
        (lambda pose: 0.001 * pose, "times as long as at rest"),
        (lambda pose: 0.0 * pose, "as long as at rest"),
        (lambda pose: pose * [1.0, 1.0, -1.0], "mirror image"),
        (lambda pose: np.random.default_rng(0).permutation(pose), "as long as at rest"),
    ],
)
def test_another_unit_or_a_mirror_image_is_refused(bar_problem, pose, change, message):
    with pytest.raises(jd.InputError, match=message):
        jd.estimate_rigidity(bar_problem, change(pose))
    with pytest.raises(jd.InputError, match=message):
        jd.estimate_rigidity_field(bar_problem, change(pose))


def test_targets_of_another_frame_are_refused(bar, bar_problem, bar_targets, pose):
    with pytest.raises(jd.InputError, match=r"handle \d+ of observed pose 0 lies 173 from"):
        jd.estimate_rigidity(bar_problem, pose + 100.0, targets=bar_targets)


@pytest.mark.slow
def test_a_pose_moved_as_a_whole_gives_the_same_answer(bar_problem, pose):
    moved = np.asarray(jd.rotate(pose, 130.0, axis=[1.0, 2.0, 3.0])) + 100.0
    fits = [jd.estimate_rigidity(bar_problem, seen) for seen in (pose, moved)]
    np.testing.assert_allclose(fits[0].rigidity, fits[1].rigidity, rtol=1e-3)
    for fit in fits:
        assert fit.ok
        assert fit.interval[0, 0] <= 20.0 <= fit.interval[0, 1]


def test_vertices_in_a_wrong_place_are_left_out(bar, bar_problem, bar_targets, pose):
    """2 % of the vertices, off by 10 % of the diagonal."""
    draw = np.random.default_rng(3)
    free = np.setdiff1d(np.arange(len(pose)), bar_problem.handles)
    wrong = np.sort(draw.choice(free, 12, replace=False))
    seen = noisy(bar, pose, seed=0)
    seen[wrong] += 0.1 * bar.diagonal * draw.standard_normal((12, 3))
    fit = jd.estimate_rigidity(bar_problem, seen, targets=bar_targets)
    assert np.isin(wrong, np.flatnonzero(fit.outliers[0])).all()
    assert fit.outliers.sum() <= 14
    assert fit.interval[0, 0] <= 20.0 <= fit.interval[0, 1]
    np.testing.assert_allclose(fit.relative_misfit, NOISE, rtol=0.1)
    assert f"({fit.outliers.sum()} in all)" in fit.explain()


@pytest.mark.slow
def test_no_vertex_of_another_model_is_called_misplaced(bar, bar_problem):
    """A pose of libigl, whose elements are others: a fifth of it was left out, round by round."""
    data = igl.ARAPData()
    data.energy, data.max_iter = igl.ARAP_ENERGY_TYPE_SPOKES_AND_RIMS, 400
    igl.arap_precomputation(bar.vertices, bar.faces, 3, bar_problem.handles, data)
    targets = np.asarray(jd.bend(bar.vertices[bar_problem.handles], 60.0))
    seen = igl.arap_solve(targets, data, bar.vertices)
    fit = jd.estimate_rigidity(bar_problem, seen, targets=targets)
    check_it_is_said(fit, 0.01)
    assert not fit.outliers.any()
    assert "if the model were right" in fit.explain()


# ---------------------------------------------------------------- parts that nothing strains


@pytest.fixture(scope="module")
def free_end(bar):
    """A bar that is bent between its lower end and its middle; 10 there, and 3 above."""
    where = jd.select.where
    held, middle = where(bar, "v < 0.04"), where(bar, "0.5 < v < 0.56")
    above = where(bar, "v > 0.62")
    problem = jd.precompute(bar, held | middle)
    moved = bar.vertices.copy()
    moved[middle] = jd.rotate(bar.vertices[middle], 40.0, axis="z", center=[0.0, 0.0, 0.0])
    truth = np.where(above.mask, 3.0, 10.0)
    targets = moved[problem.handles]
    return problem, targets, truth, above, np.asarray(jd.deform(problem, targets, truth).vertices)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_a_free_end_is_not_determined(bar, free_end, known, noise):
    """It follows the noise of its handles unless it is stiff, so it was at least 20."""
    problem, targets, _, above, pose = free_end
    for seed in range(2):
        draw = np.random.default_rng(seed).standard_normal(pose.shape)
        seen = pose + noise * bar.diagonal * draw
        given = {"targets": targets} if known else {}
        fit = jd.estimate_rigidity(problem, seen, parts=above, **given)
        assert fit.ok
        assert fit.verdict == (jd.Verdict.determined, jd.Verdict.not_determined)
        assert fit.interval[0, 0] < 10.0 < fit.interval[0, 1]
        assert fit.interval[1].tolist() == [0.0, np.inf]


@pytest.mark.slow
def test_a_field_is_not_determined_in_a_free_end(bar, free_end):
    """Its neighbours' value is known to 0.2 % and was taken for its own."""
    problem, targets, truth, _, pose = free_end
    seen = pose + 1e-4 * bar.diagonal * np.random.default_rng(0).standard_normal(pose.shape)
    fit = jd.estimate_rigidity_field(problem, seen, targets=targets)
    height = (bar.vertices[:, 1] - bar.vertices[:, 1].min()) / np.ptp(bar.vertices[:, 1])
    end, bent = height > 0.7, (height > 0.05) & (height < 0.5)
    assert not fit.determined[end].any()
    assert fit.determined[bent].all()
    assert f"determined at {100 * fit.determined.mean():.0f} % of the vertices" in fit.explain()
    covered = (fit.interval[:, 0] <= truth) & (truth <= fit.interval[:, 1])
    assert covered[end].all()
    assert covered[bent].mean() > 0.95
