"""The metric of the descent: what it is, that it is safe, and that it ends where A ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._deformation.metric import apply_metric, metric_of
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy


def slow(kind: str):
    return pytest.param(kind, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def small(exact_sizes):
    """A bumpy sheet of 16 vertices, held at one end."""
    mesh = _sheet()
    return jd.precompute(mesh, np.flatnonzero(mesh.vertices[:, 1] < 0.1))


def _sheet(n: int = 4, shear: float = 0.0) -> jd.Mesh:
    """Return a bumpy sheet; sheared by a half, half of its triangles are obtuse."""
    grid = np.linspace(0.0, 1.0, n)
    x, y = (v.ravel() for v in np.meshgrid(grid, grid, indexing="ij"))
    bumps = 0.15 * np.sin(7.0 * x) * np.cos(5.0 * y)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (
        v.ravel() for v in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return jd.Mesh(np.stack([x + shear * y, y, bumps], axis=1), faces)


def _brute_force(problem: jd.Problem, rigidity: float) -> np.ndarray:
    """Return [H(0) + H(4 lambda)] / 2, cell by cell, with every matrix dense."""
    cells, mesh = problem.cells, problem.mesh
    n = mesh.n_vertices
    total = np.zeros((n, n))
    for k in range(n):
        moment, pull, laplacian = np.zeros((3, 3)), np.zeros((3, n)), np.zeros((n, n))
        for e in cells.membership[k].indices:
            i, j = mesh.edges[e]
            w, edge, row = cells.weights[e], mesh.vertices[i] - mesh.vertices[j], np.zeros(n)
            row[i], row[j] = 1.0, -1.0
            moment += w * np.outer(edge, edge)
            pull += w * np.outer(edge, row)
            laplacian += w * np.outer(row, row)
        b, axes = np.linalg.eigh(moment)
        pull = axes.T @ pull
        for x in (0.0, 4.0 * rigidity):
            total += 0.5 * (laplacian - pull.T @ np.diag(1.0 / (b + x)) @ pull)
    return total


def _inverse(problem: jd.Problem, rigidity: float, choice) -> np.ndarray:
    """Return what the metric does to every unit vector, (vertices, vertices)."""
    system, n = problem.system, problem.n_vertices
    metric = metric_of(system, jd.Newton(), jnp.full(n, rigidity), choice)
    unit = jnp.broadcast_to(jnp.eye(n)[:, None], (n, 3, n))
    return np.asarray(jax.vmap(lambda x: apply_metric(system, metric, x))(unit)[:, 0])


@pytest.mark.parametrize("shear", [0.0, 0.5])
def test_it_is_the_formula(exact_sizes, shear):
    mesh = _sheet(shear=shear)
    problem = jd.precompute(mesh, np.flatnonzero(mesh.vertices[:, 1] < 0.1))
    assert shear == 0 or (problem.cells.weights < 0).any()  # obtuse, and yet bounded
    free, lam = np.asarray(problem.system.free), 2.0**-5  # a half octave, so not rounded up
    expected = np.linalg.inv(_brute_force(problem, lam)[np.ix_(free, free)])
    found = _inverse(problem, lam, "material")
    np.testing.assert_allclose(found[np.ix_(free, free)], expected, rtol=1e-8, atol=1e-10)
    assert not found[~free].any()
    assert not found[:, ~free].any()


@pytest.mark.parametrize("rigidity", [1e-3, 0.03, 1.0])
def test_a_plain_step_cannot_raise_the_quadratic_model(small, rigidity):
    """At unstrained cells, in any rotation, the true Hessian is at most twice the metric."""
    system, free = small.system, np.asarray(small.system.free)
    axis = jd.rotate(np.asarray(system.rest.T), 50.0, axis=[1.0, 2.0, 0.5], center=[0.0, 0.0, 0.0])
    p, n = jnp.asarray(axis).T, small.n_vertices
    inputs = Inputs(p, jnp.full(n, rigidity), system.soft)
    energy = ReducedEnergy(jd.Newton())

    def gradient(x):
        return energy.evaluate(system, inputs, x.reshape(3, n)).gradient.ravel()

    hessian = np.asarray(jax.jacfwd(gradient)(p.ravel()))
    every = np.tile(free, 3)
    hessian = hessian[np.ix_(every, every)]
    metric = np.linalg.inv(_inverse(small, rigidity, "material")[np.ix_(free, free)])
    factor = np.linalg.inv(np.linalg.cholesky(np.kron(np.eye(3), 0.5 * (metric + metric.T))))
    ratio = np.linalg.eigvalsh(factor @ hessian @ factor.T)
    assert ratio.min() > 0.0
    assert ratio.max() <= 2.0 + 1e-6


@pytest.mark.parametrize("rigidity", [0.0, 1e-3, 0.05, 1.0, 1e4])
@pytest.mark.parametrize("kind", ["rings 1", *(slow(k) for k in ("rings 2", "soft", "affine"))])
def test_it_ends_where_stiffness_ends(bar, bar_problem, bar_targets, kind, rigidity):
    cells = jd.rings(bar, 2) if kind == "rings 2" else None
    weights = 3.0 if kind == "soft" else np.inf
    problem = jd.precompute(bar, bar_problem.handles, cells=cells, handle_weights=weights)
    local = jd.AffineFit() if kind == "affine" else jd.Newton()
    ends = {}
    for choice in ("stiffness", "material"):
        solver = jd.QuasiNewton(tolerance=1e-10, max_steps=3000, metric=choice)
        out = jd.deform(problem, bar_targets, rigidity, solver=solver, local=local)
        assert bool(out.ok)
        assert np.all(np.diff(out.energy) <= 1e-12 * np.abs(out.energy[0]))
        ends[choice] = float(out.energy[-1])
    assert ends["material"] <= ends["stiffness"] * (1 + 1e-6) + 1e-9


@pytest.mark.filterwarnings("ignore:negative weights:UserWarning")
@pytest.mark.filterwarnings("ignore:weights of 0 made the system singular:UserWarning")
@pytest.mark.parametrize(
    ("kind", "shear", "rigidity"),
    [("rings", 0.5, 0.0), ("rings", 0.5, 1e-2), ("spokes", 0.5, 1e-2), ("spokes", 2.0, 0.0)],
)
def test_obtuse_triangles(kind, shear, rigidity):
    """Cells of rings keep their negative weights; those of spokes count as 0, and some are flat.

    There the metric of rigidity 0 was singular, and led out to 1e74.
    """
    mesh = _sheet(8, shear=shear)
    cells = jd.rings(mesh, 1) if kind == "rings" else jd.spokes(mesh)
    handles = jd.select.where(mesh, "v < 0.1 or v > 0.9")
    problem = jd.precompute(mesh, handles, cells=cells)
    assert (problem.cells.weights < 0).any() == (kind == "rings")
    upper = mesh.vertices[problem.handles, 1:2] > 0.5
    targets = mesh.vertices[problem.handles] + upper * np.array([0.2, -0.3, 0.4])
    ends = {}
    for choice in ("stiffness", "material"):
        solver = jd.QuasiNewton(tolerance=1e-9, max_steps=2000, metric=choice)
        out = jd.deform(problem, targets, rigidity, solver=solver)
        assert bool(out.ok)
        assert np.abs(out.vertices).max() < 1.5 + shear
        ends[choice] = float(out.energy[-1])
    assert ends["material"] <= ends["stiffness"] * (1 + 1e-6) + 1e-9


@pytest.mark.parametrize("constant", [0.01, 1e-3])
def test_soft_materials_take_few_evaluations(bar, bar_problem, bar_targets, constant):
    """To 1e-4 above the minimum at most 30, where A^-1 takes 33 and 42 here."""
    rigidity = jd.rigidity_from_material(bar_problem, constant)
    solver = jd.QuasiNewton(tolerance=1e-12, metric="stiffness", max_steps=3000)
    least = float(jd.deform(bar_problem, bar_targets, rigidity, solver=solver).energy[-1])
    energy = np.asarray(jd.deform(bar_problem, bar_targets, rigidity).energy)
    assert np.argmax(energy <= least * (1 + 1e-4)) <= 10


@pytest.mark.slow
def test_lanes_of_a_batch_have_metrics_of_their_own(bar_problem, bar_targets):
    rigidity = jnp.array([0.0, 0.02, 0.02, 3.0, 900.0])
    many = jax.vmap(lambda x: jd.deform(bar_problem, bar_targets, x))(rigidity)
    for k, x in enumerate(rigidity):
        one = jd.deform(bar_problem, bar_targets, x)
        assert int(one.steps) == int(many.steps[k])
        np.testing.assert_allclose(many.vertices[k], one.vertices, atol=1e-9)


def test_single_precision(bar, bar_problem, bar_targets):
    """A^-1 in float64 says where the minimum is."""
    single = jd.precompute(bar, bar_problem.handles, dtype=np.float32)
    for rigidity in (0.0, 0.01, 0.5):
        slow = jd.QuasiNewton(tolerance=1e-12, max_steps=3000, metric="stiffness")
        least = float(jd.deform(bar_problem, bar_targets, rigidity, solver=slow).energy[-1])
        out = jd.deform(single, bar_targets, rigidity, solver=jd.QuasiNewton(metric="material"))
        assert bool(out.ok)
        assert int(out.steps) < 30
        np.testing.assert_allclose(float(out.energy[-1]), least, rtol=2e-3)


def test_a_start_far_away_is_no_trouble(bar, bar_problem, bar_targets):
    """Strained cells are outside of what the metric is made for: the energy falls all the same."""
    start = bar.vertices + 0.1 * bar.diagonal * np.random.default_rng(0).standard_normal((722, 3))
    solver = jd.QuasiNewton(metric="material", max_steps=2000)
    out = jd.deform(bar_problem, bar_targets, 0.05, start=start, solver=solver)
    assert bool(out.ok)
    rise = np.diff(np.asarray(out.energy)[: int(out.steps) + 1])
    assert rise.max() <= 1e-12 * float(out.energy[0])


def test_rigidity_that_is_no_number_is_bad_input(bar_problem, bar_targets):
    run = jax.jit(lambda x: jd.deform(bar_problem, bar_targets, x))
    for bad in (np.nan, np.inf, -1.0):
        assert run(jnp.asarray(bad)).result == jd.Result.bad_input
