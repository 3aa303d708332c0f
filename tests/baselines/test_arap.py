"""ARAP in one call: where libigl, started from there, stays."""

import igl
import numpy as np
import pytest

import jaxdeform as jd


def turned(bar, bar_problem):
    return np.asarray(jd.bend(bar.vertices[bar_problem.handles], 30.0))


def test_libigl_stays_there(bar, bar_problem):
    handles, targets = bar_problem.handles, turned(bar, bar_problem)
    ours = np.asarray(jd.arap(bar, handles, targets))
    data = igl.ARAPData()
    data.energy, data.max_iter = igl.ARAP_ENERGY_TYPE_SPOKES, 20
    igl.arap_precomputation(bar.vertices, bar.faces, 3, handles, data)
    theirs = igl.arap_solve(targets, data, ours.copy())
    np.testing.assert_allclose(ours, theirs, atol=1e-3 * bar.diagonal)
    assert np.abs(ours - bar.vertices).max() > 0.1 * bar.diagonal


@pytest.mark.slow
def test_larger_cells_agree_more(bar, bar_problem):
    """The rotation between the ends is spread more evenly: ARAP is not what this is."""
    handles, targets = bar_problem.handles, turned(bar, bar_problem)
    one, three = (np.asarray(jd.rc_arap(bar, handles, targets, r)) for r in (1, 3))
    edge = bar.edges
    length = lambda v: np.linalg.norm(v[edge[:, 0]] - v[edge[:, 1]], axis=1)  # noqa: E731
    strain = [np.ptp(length(v) / length(bar.vertices)) for v in (one, three)]
    assert strain[1] < strain[0]


def test_a_rigid_motion_is_followed(bar, bar_problem):
    move = lambda v: np.asarray(jd.rotate(v, 40.0, axis=[1.0, 2.0, 3.0]) + 5.0)  # noqa: E731
    for found in (
        jd.arap(bar, bar_problem.handles, move(bar.vertices[bar_problem.handles])),
        jd.rc_arap(bar, bar_problem.handles, move(bar.vertices[bar_problem.handles]), 2),
    ):
        np.testing.assert_allclose(found, move(bar.vertices), atol=1e-5 * bar.diagonal)


def test_misuse_is_named(bar):
    with pytest.raises(jd.InputError, match="r = 0"):
        jd.rc_arap(bar, [0], bar.vertices[:1], 0)
    with pytest.raises(jd.InputError, match="targets"):
        jd.arap(bar, [0], bar.vertices[:2])
