"""Any unit of length gives the same, as far as the numbers reach; beyond, it is refused."""

from functools import partial

import jax
import numpy as np
import pytest
from helpers import EXACT, relative, tetrahedron

import jaxdeform as jd
from jaxdeform._deformation.local_step import solve_local_step

SCALES = [1e-137, 1e-20, 1e130]


@pytest.fixture(params=SCALES)
def scaled(request, bar):
    return request.param, jd.Mesh(bar.vertices * request.param, bar.faces)


def test_distances_along_the_surface(scaled, bar):
    """A bar 1e-20 long came out 15 % longer, one of 1e100 as 0, and one of 1e-100 did not end."""
    scale, mesh = scaled
    want = jd.geodesic_distances(bar, [0, 300])
    np.testing.assert_allclose(jd.geodesic_distances(mesh, [0, 300]) / scale, want, rtol=1e-9)


def test_handles_that_are_found(scaled, bar, bar_problem, pose_of):
    scale, mesh = scaled
    groups = jd.find_handle_groups(mesh, pose_of(1.0) * scale)
    found = np.sort(np.concatenate([group.vertices for group in groups]))
    np.testing.assert_array_equal(found, bar_problem.handles)


def test_a_deformation(scaled, bar_problem, bar_targets):
    scale, mesh = scaled
    want = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.Alternating(5))
    problem = jd.precompute(mesh, bar_problem.handles)
    out = jd.deform(problem, bar_targets * scale, scale**2, solver=jd.Alternating(5))
    assert relative(np.asarray(out.vertices) / scale, want.vertices) < EXACT
    np.testing.assert_allclose(np.asarray(out.energy) / scale**2, want.energy, rtol=1e-9)


@pytest.mark.parametrize("local", [jd.Newton(), jd.RotationFit(), jd.AffineFit()])
def test_cells_and_their_derivatives_in_float32(local):
    """A bar of 1.5e9 was 'at a saddle', one of 1.5e11 far from its minimum, and 'Converged'."""
    rng = np.random.default_rng(0)
    c = np.moveaxis(np.eye(3) + 0.5 * rng.normal(size=(50, 3, 3)), 0, -1)
    b, rigidity = rng.uniform(0.5, 2, (3, 50)), rng.uniform(0.1, 1, 50)
    moves = rng.normal(size=c.shape), rng.normal(size=b.shape), rng.normal(size=50)

    @jax.jit
    def step(square):
        scaled = jax.tree.map(lambda x: square * x.astype(np.float32), ((c, b, rigidity), moves))
        return jax.jvp(partial(solve_local_step, local), *scaled)

    want = step(np.float32(1.0))
    for scale in (1e-12, 1e12):
        for got, one in zip(step(np.float32(scale**2)), want, strict=True):
            assert relative(got, one) < 1e-3


@pytest.mark.parametrize(("scale", "unit"), [(1e306, "larger"), (1e-300, "smaller")])
def test_beyond_the_range_of_squares(scale, unit):
    """A search for handles at 1e306 did not end; energies at 1e-170 were 0, and 'Converged'."""
    v, f = tetrahedron()
    with pytest.raises(jd.InputError, match=f"in a {unit} unit of length"):
        jd.Mesh(v * scale, f)
    with pytest.raises(jd.InputError, match=f"in a {unit} unit of length"):
        jd.repair((v * scale, f))
    (finding,) = jd.inspect((v * scale, f)).findings
    assert f"in a {unit} unit of length" in finding


def test_a_pose_beyond_the_range_of_squares(bar):
    with pytest.raises(jd.InputError, match=r"vertex 0 of pose 0 is .*: give finite positions, up"):
        jd.find_handle_groups(bar, bar.vertices * 1e306)


@pytest.mark.parametrize("scale", [1e-18, 1e18])
def test_beyond_the_range_of_float32(bar, scale):
    mesh = jd.Mesh(bar.vertices * scale, bar.faces)
    with pytest.raises(jd.InputError, match="or use float64"):
        jd.precompute(mesh, [0], dtype=np.float32)
