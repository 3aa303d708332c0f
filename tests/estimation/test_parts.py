"""Known materials recovered, intervals that cover, verdicts, misuse."""

import numpy as np
import pytest
from helpers import THESIS, noisy

import jaxdeform as jd
from jaxdeform._estimation.poses import check_poses
from jaxdeform._mesh.selection import check_parts

# ---------------------------------------------------------------- recovery


@pytest.mark.parametrize(
    "true", [*(pytest.param(x, marks=pytest.mark.slow) for x in (0.05, 30.0)), 1.0]
)
def test_one_rigidity_is_recovered_from_a_soft_start(
    bar, bar_problem, bar_targets, equilibrium_of, true
):
    """The pose is made by another solver, to its end."""
    fit = jd.estimate_rigidity(bar_problem, equilibrium_of(true), targets=bar_targets, start=0.01)
    assert abs(fit.rigidity[0] / true - 1) < 1e-3
    assert len(fit.history) <= 15
    assert fit.ok
    assert fit.interval[0, 0] <= true <= fit.interval[0, 1]
    assert fit.interval[0, 1] / fit.interval[0, 0] < 1.1
    assert fit.verdict == (jd.Verdict.determined,)
    np.testing.assert_allclose(fit.vertices[0], equilibrium_of(true), atol=1e-5 * bar.diagonal)


@pytest.mark.parametrize("tolerance", [1e-6, pytest.param(1e-12, marks=pytest.mark.slow)])
def test_the_interval_allows_for_the_solver_that_made_the_pose(bar_problem, bar_targets, tolerance):
    pose = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.QuasiNewton(tolerance)).vertices
    settings = jd.QuasiNewton(max(tolerance, 1e-8))
    fit = jd.estimate_rigidity(bar_problem, pose, targets=bar_targets, solver=settings)
    assert fit.ok
    assert fit.interval[0, 0] <= 1.0 <= fit.interval[0, 1]
    assert fit.misfit <= 3.0 * fit.solver_error


@pytest.mark.slow
def test_poses_of_the_thesis_are_fitted_by_its_iteration(bar_problem, pose_of):
    fit = jd.estimate_rigidity(bar_problem, pose_of(1.0), solver=THESIS)
    assert abs(fit.rigidity[0] - 1.0) < 1e-6
    assert fit.ok
    assert fit.solver_error == 0.0


@pytest.mark.slow
def test_two_materials_are_recovered_though_some_vertices_are_hidden(
    bar_problem, equilibrium_of, halves
):
    true = np.array([0.01, 30.0])
    pose = np.array(equilibrium_of(true[halves]))
    seen = np.ones(len(pose), bool)
    free = np.setdiff1d(np.arange(len(pose)), bar_problem.handles)
    seen[free[::7]] = False
    pose[~seen] = np.nan
    fit = jd.estimate_rigidity(bar_problem, pose, parts=halves, mask=seen)
    np.testing.assert_allclose(fit.rigidity, true, rtol=0.01)
    assert (fit.interval[:, 0] <= true).all()
    assert (fit.interval[:, 1] >= true).all()
    np.testing.assert_array_equal(fit.field, fit.rigidity[halves])
    assert fit.ok


@pytest.mark.slow
def test_the_rest_shape_tells_nothing(bar, bar_problem):
    fit = jd.estimate_rigidity(bar_problem, bar.vertices)
    assert fit.verdict == (jd.Verdict.not_determined,)
    assert fit.interval.tolist() == [[0.0, np.inf]]
    assert "softer or stiffer makes no visible difference" in fit.explain()


@pytest.mark.slow
def test_a_stiff_bar_is_at_least_so_stiff(bar, bar_problem, bar_targets, equilibrium_of):
    """At rigidity 1e6 nothing changes any more."""
    seen = noisy(bar, equilibrium_of(1e6), seed=0)
    fit = jd.estimate_rigidity(bar_problem, seen, targets=bar_targets)
    assert fit.verdict == (jd.Verdict.at_least,)
    assert 100 < fit.interval[0, 0] < 1e6
    assert np.isinf(fit.interval[0, 1])
    assert f"at least {fit.interval[0, 0]:.3g}" in fit.explain()
    assert "rigidity in squared mesh units; misfit" in fit.explain()


@pytest.mark.slow
def test_a_part_that_hardly_moves_is_not_determined(bar, bar_problem, equilibrium_of):
    """A patch deep inside a handle has no influence on any free vertex."""
    low = bar.vertices[:, 1] == 0.0
    parts = (low & (np.abs(bar.vertices[:, [0, 2]]) < 6).all(axis=1)).astype(int)
    assert parts.sum() > 0
    fit = jd.estimate_rigidity(bar_problem, noisy(bar, equilibrium_of(1.0), seed=1), parts=parts)
    assert fit.verdict == (jd.Verdict.determined, jd.Verdict.not_determined)
    assert fit.interval[0, 0] < 1.0 < fit.interval[0, 1]
    assert (fit.displacement[1] < 1e-3 * bar.diagonal).all()


@pytest.mark.slow
def test_one_part_or_two_halves_have_the_same_verdict(bar, bar_problem, halves):
    points = bar.vertices[bar_problem.handles]
    stretched = points + np.where(points[:, 1:2] > 75, 30.2, 0.0) * [[0.0, 1.0, 0.0]]
    pose = jd.deform(bar_problem, stretched, 20.0).vertices
    one = jd.estimate_rigidity(bar_problem, pose, targets=stretched)
    two = jd.estimate_rigidity(bar_problem, pose, targets=stretched, parts=halves)
    assert one.verdict * 2 == two.verdict == (jd.Verdict.determined,) * 2
    np.testing.assert_allclose(two.rigidity, 20.0, rtol=0.01)
    assert "stiffer makes no visible difference" in one.explain()


@pytest.mark.slow
@pytest.mark.parametrize(("targets_known", "first"), [(True, 0), (False, 1000)])
def test_intervals_cover_the_truth(
    bar, bar_problem, bar_targets, equilibrium_of, targets_known, first
):
    """20 seeds: a right 95 % interval covers in 17 or more of them with probability 0.98.

    With observed targets the handles are noisy too. test_spectrum.py has the many draws.
    """
    pose, hits = equilibrium_of(0.1), 0
    targets = bar_targets if targets_known else None
    for seed in range(first, first + 20):
        fit = jd.estimate_rigidity(bar_problem, noisy(bar, pose, seed), targets=targets)
        low, high = fit.interval[0]
        hits += low <= 0.1 <= high
    assert hits >= 17


@pytest.mark.slow
def test_measured_targets_must_be_called_so(bar, bar_problem, equilibrium_of):
    """Measured handles, given as exact, make the interval too narrow; as noisy, it covers.

    The errors, in standard errors, should have a mean square of 1: it is 6 with these. Of 8
    intervals of 95 %, five or fewer cover in 0.6 % of all draws.
    """
    pose, square, hits = equilibrium_of(20.0), 0.0, 0
    for seed in range(8):
        seen = noisy(bar, pose, seed)
        exact, measured = (
            jd.estimate_rigidity(
                bar_problem, seen, targets=seen[bar_problem.handles], target_noise=noise
            )
            for noise in (0.0, 1.0)
        )
        low, high = exact.interval[0]
        square += (np.log(exact.rigidity[0] / 20.0) / (np.log(high / low) / (2 * 1.96))) ** 2 / 8
        hits += measured.interval[0, 0] <= 20.0 <= measured.interval[0, 1]
    assert square > 2.0
    assert hits >= 6


# ---------------------------------------------------------------- misuse


def test_misuse_is_told_at_once(bar, bar_problem):
    good = bar.vertices
    hole = np.array(good)
    hole[300] = np.nan
    unseen = np.ones(len(good), bool)
    unseen[bar_problem.handles[0]] = False
    gap = np.zeros(len(good), int)
    gap[0] = 2
    fit = jd.estimate_rigidity
    cases = [
        (lambda: fit(bar_problem, good[:-1]), "observed has shape"),
        (lambda: fit(bar_problem, hole), "vertex 300 of observed pose 0"),
        (lambda: fit(bar_problem, good, mask=unseen), "handle .* was not seen.*give targets"),
        (lambda: fit(bar_problem, good, mask=unseen[:-1]), "mask has shape"),
        (lambda: fit(bar_problem, good, parts=gap), "no vertex belongs to part 1"),
        (lambda: fit(bar_problem, good, parts=gap[:-1]), "parts have shape"),
        (
            lambda: fit(bar_problem, good, parts=gap - 1),
            "the part of vertex 1 is -1, out of range: number from 0",
        ),
        (lambda: fit(bar_problem, good, start=0.0), "start must be above 0"),
        (lambda: fit(bar_problem, good, targets=good[:3]), "targets have shape"),
        (lambda: jd.estimate_rigidity_field(bar_problem, good, smoothness=0.0), "smoothness"),
        (
            lambda: jd.estimate_rigidity_thesis(bar_problem, np.stack([good, good])),
            "observed holds 2 poses, .* takes one",
        ),
        (lambda: jd.find_handles(bar, good[:-1]), "deformed has shape"),
        (lambda: jd.find_handles(bar, hole), "vertex 300 of pose 0"),
        (lambda: jd.find_handles(bar, good, tolerance=0.0), "tolerance"),
        (lambda: jd.find_handles(bar, good**2), "no handles found"),
    ]
    for call, message in cases:
        with pytest.raises(jd.InputError, match=message):
            call()


def test_selections_and_masks_stand_for_parts_and_for_what_was_seen(bar, bar_problem, halves):
    upper = jd.select.mask(bar, halves == 1)
    for parts in (upper, halves == 1, (halves == 1).tolist()):
        np.testing.assert_array_equal(check_parts(parts, bar), halves)
    wanted = check_poses(bar_problem, bar.vertices, bar.vertices[bar_problem.handles], halves == 1)
    found = check_poses(bar_problem, bar.vertices, bar.vertices[bar_problem.handles], upper)
    np.testing.assert_array_equal(found.counted, wanted.counted)
    with pytest.raises(jd.InputError, match="no vertex belongs to part 0"):
        check_parts(upper | ~upper, bar)
    other = jd.select.where(jd.Mesh(bar.vertices, bar.faces[::-1]), "y < 6")
    with pytest.raises(jd.InputError, match="parts: the selection is of another mesh"):
        check_parts(other, bar)
    with pytest.raises(jd.InputError, match="mask: the selection is of another mesh"):
        check_poses(bar_problem, bar.vertices, None, other)
    with pytest.raises(jd.InputError, match=r"mask has shape \(9,\).*a jd.Selection of this mesh"):
        check_poses(bar_problem, bar.vertices, None, np.ones(9, bool))
