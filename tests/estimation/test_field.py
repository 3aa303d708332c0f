"""Smooth fields."""

import numpy as np
import pytest
from helpers import ends

import jaxdeform as jd


@pytest.mark.slow
def test_a_smooth_field_is_recovered_from_three_poses(bar, bar_problem):
    points = bar.vertices[bar_problem.handles]
    up = np.where(points[:, 1:2] > 75, 30.0, 0.0) * np.array([[0.0, 1.0, 0.0]])
    targets = np.stack([jd.bend(points, 90.0), jd.twist(points, 90.0), points + up])
    true = 0.01 * 1000.0 ** (bar.vertices[:, 1] / 151.0)
    poses = np.stack([np.asarray(jd.deform(bar_problem, t, true).vertices) for t in targets])
    assert len(ends(bar)) == len(points)
    fit = jd.estimate_rigidity_field(bar_problem, poses, smoothness=1e-9)
    assert np.median(np.abs(fit.field / true - 1)) < 0.1
