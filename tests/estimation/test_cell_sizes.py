"""The size of the cells of each part: poses of known sizes, made by another solver."""

import numpy as np
import pytest
from helpers import ends, noisy

import jaxdeform as jd

OTHER = jd.QuasiNewton(tolerance=1e-12, metric="stiffness")
"""Than that of the fit."""


def made(mesh, sizes, rigidity, degrees=90.0, noise=0.0):
    """Return a problem with cells of one ring, and a pose of cells of other sizes."""
    handles = ends(mesh)
    targets = jd.bend(mesh.vertices[handles], degrees)
    wide = jd.precompute(mesh, handles, cells=jd.rings(mesh, sizes))
    pose = np.asarray(jd.deform(wide, targets, rigidity, solver=OTHER).vertices)
    return jd.precompute(mesh, handles), noisy(mesh, pose, 0, noise), targets


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_the_sizes_of_two_parts(bar, noise):
    upper = bar.vertices[:, 1] > 75
    sizes, truth = np.where(upper, 1, 2), np.where(upper, 30.0, 0.5)
    problem, pose, targets = made(bar, sizes, truth, noise=noise)
    found = jd.estimate_rings(problem, pose, parts=upper, targets=targets)
    assert found.rings.tolist() == [2, 1]
    assert found.ok
    assert found.explain().startswith("rings of the parts: 2, 1 (of ")
    np.testing.assert_allclose(found.fit.rigidity, [0.5, 30.0], rtol=0.1 if noise else 1e-3)
    assert found.problem.cells.membership.nnz == jd.rings(bar, sizes).membership.nnz
    alone = jd.estimate_rigidity(problem, pose, parts=upper, targets=targets)
    assert alone.result == jd.Result.unexplained
    best = found.tried[found.misfits.argmin()]
    np.testing.assert_array_equal(best, found.rings)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 2])
def test_the_size_of_one_part(bar, size):
    problem, pose, targets = made(bar, size, 5.0)
    told = []
    found = jd.estimate_rings(
        problem, pose, targets=targets, most=2, progress=lambda *x: told.append(x)
    )
    assert found.rings.tolist() == [size]
    np.testing.assert_allclose(found.fit.rigidity, 5.0, rtol=1e-3)
    assert [sizes.tolist() for sizes, _ in told] == found.tried.tolist() == [[1], [2]]
    assert [misfit for _, misfit in told] == found.misfits.tolist()


def test_where_poses_do_not_tell_cells_are_small():
    mesh = jd.shapes.square()
    weights, soft = np.linspace(1.0, 2.0, len(mesh.edges)), [np.inf, np.inf, np.inf, 5.0, 5.0, 0.5]
    cells = jd.rings(mesh, 2, weights=weights)
    problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8], cells=cells, handle_weights=soft)
    found = jd.estimate_rings(problem, mesh.vertices, most=2)
    assert found.rings.tolist() == [1]
    # What is not the size of the cells stays.
    np.testing.assert_array_equal(found.problem.cells.weights, weights)
    kept = found.problem.system
    np.testing.assert_array_equal(kept.soft, problem.system.soft)
    np.testing.assert_array_equal(kept.free, problem.system.free)
