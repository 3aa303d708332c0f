"""A minimum is told from a saddle, and saddles are left: other programs' shapes are the witness."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NO_SADDLES

import jaxdeform as jd
from benchmarks.saddles import sheet
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.saddles import lowest_curvature
from jaxdeform._linalg.buckets import fill_up


@pytest.fixture(scope="module")
def pushed(bar, bar_problem):
    """The bar pushed together by 30 of its 151 units: it buckles."""
    hold = bar.vertices[bar_problem.handles]
    return hold - np.where(hold[:, 1:2] > 75, [[0.0, 30.0, 0.0]], 0.0)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_rigid_motion_is_a_minimum(dtype):
    """Of energy 0, whose curvature is 0 along the turns about its one handle, but for rounding."""
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [4], dtype=dtype)
    moved = np.asarray(jd.rotate(mesh.vertices, 40.0, axis="x")) + np.arange(3.0)
    assert bool(jd.is_minimum(problem, moved[[4]], 1.0, moved))


@pytest.mark.slow
def test_the_curvature_is_that_of_the_energy(bar, bar_problem, pushed):
    """Along the direction that it returns, second differences of the energy are negative."""
    out = jd.deform(bar_problem, pushed, 30.0, solver=NO_SADDLES)
    system = bar_problem.system
    energy = ReducedEnergy(jd.Newton())
    size = bar_problem.bucket
    p = jnp.asarray(fill_up((out.vertices - system.center[None]).T, size))
    inputs = Inputs(p, jnp.full(size, 30.0), system.soft)
    t = energy.evaluate(system, inputs, p).transforms
    value, x, _ = lowest_curvature(energy, system, inputs, None, p, t)
    at = lambda s: float(energy.evaluate(system, inputs, p + s * x).energy)  # noqa: E731
    step = 0.1
    second = (at(step) - 2.0 * at(0.0) + at(-step)) / (2.0 * step**2)
    np.testing.assert_allclose(float(value), second, rtol=1e-3)
    assert second < -0.01


def test_the_rigid_bar_ends_where_libigl_does(bar, bar_handles_bent):
    """libigl's alternating iteration leaves the saddle by its rounding errors, after 400 steps."""
    problem, targets = bar_handles_bent
    kwargs = {"local": jd.RotationFit()}
    stays = jd.deform(problem, targets, 1.0, solver=NO_SADDLES, **kwargs)
    out = jd.deform(problem, targets, 1.0, **kwargs)
    assert bool(out.ok)
    data = igl.ARAPData()
    data.energy, data.max_iter = igl.ARAP_ENERGY_TYPE_SPOKES, 1600
    igl.arap_precomputation(bar.vertices, bar.faces, 3, problem.handles, data)
    other = igl.arap_solve(targets, data, np.asarray(out.vertices))
    rotations = jd.deform(problem, targets, 1.0, start=other, solver=jd.Alternating(1), **kwargs)
    np.testing.assert_allclose(float(out.energy[-1]), float(rotations.energy[-1]), rtol=1e-6)
    assert float(out.energy[-1]) < 0.9 * float(stays.energy[-1])


@pytest.fixture(scope="module")
def bar_handles_bent(bar, bar_problem, bar_targets):
    problem = jd.precompute(bar, bar_problem.handles, cells=jd.spokes(bar))
    return problem, np.asarray(bar_targets)


def test_a_pushed_bar_buckles(bar_problem, pushed):
    stays = jd.deform(bar_problem, pushed, 30.0, solver=NO_SADDLES)
    out = jd.deform(bar_problem, pushed, 30.0)
    noise = 0.15 * np.random.default_rng(0).standard_normal((722, 3))
    seen = jd.deform(bar_problem, pushed, 30.0, start=stays.vertices + noise, solver=NO_SADDLES)
    assert bool(out.ok)
    np.testing.assert_allclose(float(out.energy[-1]), float(seen.energy[-1]), rtol=1e-6)
    assert float(out.energy[-1]) < 0.95 * float(stays.energy[-1])
    steps = int(out.steps)
    assert np.all(np.diff(out.energy[: int(stays.steps) + 1]) <= 0)
    np.testing.assert_array_equal(out.energy[steps:], out.energy[steps])


def test_minima_are_left_alone(bar_problem, bar_targets):
    for rigidity in (0.05, 30.0):
        stays = jd.deform(bar_problem, bar_targets, rigidity, solver=NO_SADDLES)
        out = jd.deform(bar_problem, bar_targets, rigidity)
        np.testing.assert_array_equal(out.vertices, stays.vertices)
        assert int(out.steps) == int(stays.steps)


@pytest.mark.slow
def test_members_of_a_batch_leave_on_their_own(bar_problem, pushed):
    rigidity = jnp.array([1.0, 30.0, 60.0])
    many = jax.jit(jax.vmap(lambda x: jd.deform(bar_problem, pushed, x)))(rigidity)
    for k, x in enumerate(rigidity):
        one = jd.deform(bar_problem, pushed, x)
        np.testing.assert_allclose(many.energy[k, -1], one.energy[-1], rtol=1e-7)


def test_single_precision(bar, bar_problem, pushed):
    single = jd.precompute(bar, bar_problem.handles, dtype=np.float32)
    least = float(jd.deform(bar_problem, pushed, 30.0).energy[-1])
    out = jd.deform(single, pushed, 30.0)
    np.testing.assert_allclose(float(out.energy[-1]), least, rtol=1e-3)


def test_the_step_limit_holds_for_all_descents_together(bar_problem, pushed):
    out = jd.deform(bar_problem, pushed, 30.0, solver=jd.QuasiNewton(max_steps=12))
    assert int(out.steps) <= 12
    assert out.energy.shape == (13,)
    assert out.result == jd.Result.step_limit


def test_a_long_valley_is_followed_to_its_end():
    """A plate, bent flat by 90 degrees: at 36.03 a step gains less than 1e-8 of the energy."""
    mesh = sheet(16, 40, closed=False)
    handles = jd.select.where(mesh, "v < 0.06 or v > 0.94")
    problem = jd.precompute(mesh, handles)
    targets = jd.bend(mesh.vertices[handles.vertices], 90.0)
    rigidity = jd.rigidity_from_material(problem, 1.0)
    out = jd.deform(problem, targets, rigidity)
    to_the_end = jd.deform(problem, targets, rigidity, solver=jd.QuasiNewton(tolerance=1e-13))
    assert bool(out.ok)
    assert float(to_the_end.energy[-1]) < 25.0
    np.testing.assert_allclose(out.energy[-1], to_the_end.energy[-1], rtol=1e-6)
    scales = 0.01, 1.0, 100.0  # each with a tolerance of its own
    many = jax.vmap(lambda scale: jd.deform(problem, targets, scale * rigidity).energy[-1])
    alone = [jd.deform(problem, targets, scale * rigidity).energy[-1] for scale in scales]
    np.testing.assert_allclose(many(jnp.array(scales)), alone, rtol=1e-6)
