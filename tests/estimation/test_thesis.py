"""Algorithm 1 of the thesis."""

import numpy as np
from helpers import EXACT, THESIS

import jaxdeform as jd


def test_algorithm_1_is_as_written(bar_problem, pose_of):
    found = jd.estimate_rigidity_thesis(bar_problem, pose_of(1.0), step_size=0.001, threshold=0.05)
    np.testing.assert_allclose(np.diff(found.path), 0.001 * found.history[:-1], rtol=EXACT)
    assert found.path[0] == 1e-6
    assert (np.diff(found.path) > 0).all()
    last = found.rigidity - found.path[-1]
    assert last / found.rigidity < 0.05
    error = np.linalg.norm(
        np.asarray(
            jd.deform(
                bar_problem, pose_of(1.0)[bar_problem.handles], found.path[-1], solver=THESIS
            ).vertices
        )
        - pose_of(1.0)
    )
    np.testing.assert_allclose(found.history[-1], error, rtol=1e-8)
