"""QuasiNewton against SciPy's minimiser, on an energy written as loops over cells."""

import jax
import numpy as np
import pytest
from helpers import held_sheet
from scipy.optimize import minimize
from small_meshes import brute_cells

import jaxdeform as jd


@pytest.fixture(scope="module")
def case():
    mesh, handles, targets = held_sheet()
    return mesh, jd.precompute(mesh, handles), targets


def rigid_energy(mesh, cells, p):
    """Eq. 4.4 with the best rotations (by SVD), and its gradient."""
    value, slope = 0.0, np.zeros_like(p)
    weights = jd.cotangent_weights(mesh)
    for edges in cells:
        i, j = mesh.edges[edges].T
        w = weights[edges, None]
        before, after = mesh.vertices[i] - mesh.vertices[j], p[i] - p[j]
        u, _, vt = np.linalg.svd((w * before).T @ after)
        t = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ u.T
        left = after - before @ t.T
        value += np.sum(w * left**2)
        np.add.at(slope, i, 2 * w * left)
        np.add.at(slope, j, -2 * w * left)
    return value, slope


def test_it_reaches_the_minimum_of_scipy(case):
    mesh, problem, targets = case
    cells = brute_cells(mesh, np.ones(mesh.n_vertices, int))
    free = np.setdiff1d(np.arange(mesh.n_vertices), problem.handles)
    out = jd.deform(
        problem, targets, 0.0, local=jd.RotationFit(), solver=jd.QuasiNewton(tolerance=1e-14)
    )
    start = jd.deform(
        problem, targets, 0.0, local=jd.RotationFit(), solver=jd.Alternating(5)
    ).vertices
    p = np.array(start)

    def function(x):
        p[free] = x.reshape(-1, 3)
        value, slope = rigid_energy(mesh, cells, p)
        return value, slope[free].ravel()

    options = {"maxiter": 5000, "maxfun": 10000, "ftol": 1e-15, "gtol": 1e-10}
    found = minimize(function, p[free].ravel(), jac=True, method="L-BFGS-B", options=options)
    assert out.result == jd.Result.converged
    np.testing.assert_allclose(out.energy[-1], found.fun, rtol=1e-9)
    np.testing.assert_allclose(out.vertices[free], found.x.reshape(-1, 3), atol=1e-4)


@pytest.mark.parametrize("length", [1, 12])
def test_every_length_of_its_history_ends_at_the_same_minimum(case, length):
    _, problem, targets = case
    solver = jd.QuasiNewton(tolerance=1e-12, history_length=length, leave_saddles=False)
    out = jd.deform(problem, targets, 0.3, solver=solver)
    want = jd.deform(problem, targets, 0.3, solver=jd.Alternating(3000))
    assert out.result == jd.Result.converged
    np.testing.assert_allclose(out.energy[-1], want.energy[-1], rtol=1e-9)


def test_it_stops_at_its_step_limit_and_says_so(case):
    _, problem, targets = case
    out = jd.deform(problem, targets, 0.3, solver=jd.QuasiNewton(tolerance=0.0, max_steps=3))
    assert out.result == jd.Result.step_limit
    assert int(out.steps) == 3
    assert out.energy.shape == (4,)
    assert not bool(jax.numpy.isnan(out.energy).any())
