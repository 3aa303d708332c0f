"""Nested dissection against SciPy, and deformations as on an accelerator."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg
from helpers import EXACT, ends

import jaxdeform as jd
from benchmarks.harness import compilations
from jaxdeform._deformation.covariance import stiffness
from jaxdeform._linalg import cholesky, elimination_tree
from jaxdeform._linalg.nested_dissection import DissectedFactor, dissected_factor
from jaxdeform._mesh.laplacian import normalised_laplacian


@pytest.fixture
def accelerator(monkeypatch):
    """Choose as on a GPU, also on small meshes.

    The choice is made at trace time, so nothing traced before may serve.
    """
    jax.clear_caches()
    monkeypatch.setattr(cholesky, "DENSE_BELOW", 0)
    monkeypatch.setattr(cholesky, "has_accelerator", lambda: True)
    monkeypatch.setattr("jaxdeform._linalg.lbfgs.has_accelerator", lambda: True)
    yield
    jax.clear_caches()


def _stiffness(mesh):
    return stiffness(jd.rings(mesh, 1)), mesh.vertices


def _wheel():
    """One hub with 1,500 neighbours: a row without end."""
    angle = np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    k = np.arange(1500)
    faces = np.stack([np.full(1500, 1500), k, (k + 1) % 1500], axis=1)
    return _stiffness(jd.Mesh(np.concatenate([rim, [[0.0, 0.0, 0.3]]]), faces))


def _two_pieces():
    one = jd.shapes.bar()
    both = np.concatenate([one.vertices, one.vertices + np.array([[50.0, 0.0, 0.0]])])
    return _stiffness(jd.Mesh(both, np.concatenate([one.faces, one.faces + one.n_vertices])))


def _bilaplacian():
    mesh = jd.shapes.bar()
    cells = jd.spokes(mesh)
    laplacian = normalised_laplacian(cells.edges, cells.weights, cells.n_vertices)
    return laplacian.T @ laplacian, mesh.vertices


def _random():
    """No mesh at all, in no space: parts that share many neighbours."""
    rng = np.random.default_rng(1)
    half = sp.random(400, 400, density=0.01, rng=rng, format="csr")
    return half @ half.T + sp.identity(400), rng.normal(size=(400, 3))


CASES = {
    "cylinder": lambda: _stiffness(jd.shapes.cylinder()),
    "octopus": lambda: _stiffness(jd.shapes.octopus(5000)),
    "wheel": _wheel,
    "two pieces": _two_pieces,
    "bilaplacian": _bilaplacian,
    "random": _random,
    "diagonal": lambda: (sp.diags(np.arange(1.0, 301.0)), np.zeros((300, 3))),
    "one": lambda: (sp.csr_matrix([[2.0]]), np.ones((1, 3))),
}


@pytest.mark.parametrize("name", CASES)
def test_dissected_solve_is_the_direct_solve(name):
    matrix, positions = CASES[name]()
    matrix, n = sp.csr_matrix(matrix), matrix.shape[0]
    free = np.random.default_rng(0).random(n) > 0.05
    factor = dissected_factor(matrix, free, positions, np.dtype(float))
    right = np.random.default_rng(2).normal(size=(2, 3, n))
    got = np.asarray(jax.jit(lambda f, b: f.solve(b))(factor, right))
    assert got.shape == right.shape
    assert np.all(got[..., ~free] == 0.0)
    inner = matrix[free][:, free].tocsc()
    x, b = got[..., free].reshape(6, -1).T, right[..., free].reshape(6, -1).T
    # The residual, because the matrices' condition differs; then the solution itself.
    scale = abs(inner).sum(axis=1).max() * np.abs(x).max()
    assert np.abs(inner @ x - b).max() < EXACT * scale
    direct = scipy.sparse.linalg.spsolve(inner, b).reshape(x.shape)
    np.testing.assert_allclose(x, direct, atol=1e-7 * np.abs(direct).max())


def test_dissected_solve_in_single_precision():
    matrix, positions = CASES["cylinder"]()
    free = np.ones(matrix.shape[0], bool)
    free[:200] = False
    right = np.random.default_rng(0).normal(size=(3, len(free)))
    solve = jax.jit(lambda factor, b: factor.solve(b))
    low, high = (
        solve(dissected_factor(matrix, free, positions, np.dtype(t)), right.astype(t))
        for t in ("f4", "f8")
    )
    assert low.dtype == jnp.float32
    # Condition about 1e4 times the rounding of float32, 6e-8.
    assert np.abs(np.asarray(low) - np.asarray(high)).max() < 1e-3 * np.abs(high).max()


def test_dissected_solve_under_transformations():
    mesh = jd.shapes.bar()
    matrix, positions = _stiffness(mesh)
    free = np.arange(mesh.n_vertices) % 7 > 0
    factor = dissected_factor(matrix, free, positions, np.dtype(float))
    solve = jax.jit(lambda b: factor.solve(b))
    b, y = np.random.default_rng(0).normal(size=(2, 4, mesh.n_vertices))
    x, other = solve(b), solve(y)
    np.testing.assert_allclose(jax.jit(jax.vmap(factor.solve))(b), x, atol=EXACT)
    # The inverse is symmetric, so its pullback is itself; and linear, so its tangent is too.
    pull = jax.jit(lambda b, y: jax.vjp(factor.solve, b)[1](y)[0])(b, y)
    push = jax.jit(lambda b, y: jax.jvp(factor.solve, (b,), (y,))[1])(b, y)
    np.testing.assert_allclose(pull, other, atol=EXACT)
    np.testing.assert_allclose(push, other, atol=EXACT)
    assert abs(np.vdot(x, y) - np.vdot(b, other)) < EXACT * np.vdot(x, x)


def test_dissected_shapes_do_not_depend_on_the_handles():
    matrix, positions = CASES["cylinder"]()
    rng = np.random.default_rng(0)
    shapes = []
    for share in (0.001, 0.3, 1.0):
        free = rng.random(matrix.shape[0]) > share
        factor = dissected_factor(matrix, free, positions, np.dtype(float))
        shapes.append([x.shape for x in jax.tree.leaves(factor)])
    assert shapes[0] == shapes[1] == shapes[2]


def test_dissected_factor_refuses_an_indefinite_matrix(accelerator):
    matrix, positions = CASES["cylinder"]()
    free = np.ones(matrix.shape[0], bool)
    with pytest.raises(cholesky.NotPositiveDefinite):
        cholesky.factorise(-matrix, free, np.dtype(float), positions=positions)


@pytest.mark.parametrize("scale", [2.0**-500, 2.0**500])
def test_the_cut_does_not_depend_on_the_scale(scale):
    x = jd.shapes.cylinder().vertices
    np.testing.assert_array_equal(
        elimination_tree.bisect(x * scale, 5), elimination_tree.bisect(x, 5)
    )


def test_separators_separate():
    """No entry joins two parts of which neither is above the other."""
    matrix, positions = CASES["cylinder"]()
    i, j = sp.coo_matrix(matrix).row.astype(int), sp.coo_matrix(matrix).col.astype(int)
    depth = 5
    label = elimination_tree.bisect(positions, depth)
    assert np.ptp(np.bincount(label)) <= 1
    level, part = elimination_tree.separators(i, j, label, depth)
    shallow = np.minimum(level[i], level[j])
    np.testing.assert_array_equal(part[i] >> (level[i] - shallow), part[j] >> (level[j] - shallow))


def test_vertex_cover_is_the_least():
    rng = np.random.default_rng(3)
    for _ in range(40):
        edges = np.unique(rng.integers(0, 6, size=(rng.integers(1, 12), 2)), axis=0)
        one, two = edges[:, 0], edges[:, 1] + 6
        cover = set(elimination_tree.vertex_cover(one, two).tolist())
        covers = lambda c, one=one, two=two: all(  # noqa: E731
            a in c or b in c for a, b in zip(one, two, strict=True)
        )
        assert covers(cover)
        vertices = sorted({*one.tolist(), *two.tolist()})
        assert not any(covers(set(c)) for c in combinations(vertices, len(cover) - 1))


# ---------------------------------------------------------------- as on a GPU


def test_deform_on_an_accelerator(bar, bar_problem, bar_targets, accelerator):
    problem = jd.precompute(bar, bar_problem.handles)
    assert isinstance(problem.system.factor, DissectedFactor)
    # The metric of an accelerator, for both: what differs is the factor.
    solver = jd.QuasiNewton(metric="stiffness")
    out, peer = (jd.deform(p, bar_targets, 0.1, solver=solver) for p in (problem, bar_problem))
    assert bool(out.ok)
    # Both stop within 1e-8 of the energy's minimum, which leaves the vertices this far apart.
    np.testing.assert_allclose(out.vertices, peer.vertices, atol=1e-3)
    np.testing.assert_allclose(out.energy[-1], peer.energy[-1], rtol=1e-7)


@pytest.mark.slow
def test_slopes_of_a_batch_on_an_accelerator(bar, bar_problem, bar_targets, accelerator):
    problem = jd.precompute(bar, bar_problem.handles)

    @jax.jit
    def run(problem, lam):
        loss = lambda r: jnp.sum(jd.deform(problem, bar_targets, r).vertices ** 2)  # noqa: E731
        return jax.vmap(jax.value_and_grad(loss))(lam)

    lam = jnp.asarray([0.1, 1.0])
    (value, slope), (peer_value, peer_slope) = run(problem, lam), run(bar_problem, lam)
    # The same minimum, approached on paths that differ by rounding.
    np.testing.assert_allclose(value, peer_value, rtol=1e-6)
    np.testing.assert_allclose(slope, peer_slope, rtol=1e-2)


@pytest.mark.slow
def test_an_accelerator_runs_without_the_host(bar, accelerator):
    """Given a start, nothing calls back; and other handles compile nothing."""

    def prepare(handles, solver):
        problem = jd.precompute(bar, handles)
        return lambda t: jd.deform(problem, t, 0.1, solver=solver, start=bar.vertices).vertices

    handles, few = ends(bar), jd.Alternating(2)
    run, points = prepare(handles, jd.QuasiNewton()), jnp.asarray(bar.vertices[handles])
    slope = jax.grad(lambda t: jnp.sum(run(t)))
    for function, argument in ((run, points), (slope, points), (jax.vmap(run), points[None])):
        program = str(jax.make_jaxpr(function)(argument))
        assert "callback" not in program
        assert "ffi_call" not in program
    prepare(handles, few)(points)
    handles = np.flatnonzero(bar.vertices[:, 1] > 70)
    run = prepare(handles, few)
    with compilations() as compiled:
        run(bar.vertices[handles] + 0.1)
    assert compiled == []


def products(jaxpr):
    """Yield every dot_general of a jaxpr, those inside others included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_jaxpr):
            if _is_jaxpr(value):
                yield from products(getattr(value, "jaxpr", value))


def _is_jaxpr(x) -> bool:
    return hasattr(x, "eqns") or hasattr(x, "jaxpr")


@pytest.mark.slow
def test_all_products_are_exact_on_a_gpu(bar, accelerator):
    """A GPU would by default multiply float32 as TF32, with three digits."""
    handles = ends(bar)
    problem = jd.precompute(bar, handles, dtype=np.float32)
    assert isinstance(problem.system.factor, DissectedFactor)
    targets = jnp.asarray(bar.vertices[handles], jnp.float32)
    weights = jnp.full((bar.n_vertices, 2), 0.5, jnp.float32)
    transforms = jnp.broadcast_to(jnp.eye(3, 4, dtype=jnp.float32), (2, 3, 4))
    points = jnp.asarray(bar.vertices, jnp.float32)
    two = jd.Alternating(2)
    total = lambda out: jnp.sum(out.vertices)  # noqa: E731
    functions = [
        lambda: jd.deform(problem, targets, 1.0),
        lambda: jd.deform(problem, targets, 1.0, solver=two, normals=True),
        lambda: jd.deform(problem, targets, 1.0, local=jd.RotationFit()),
        lambda: jd.deform(problem, targets, 1.0, local=jd.AffineFit()),
        lambda: jd.deform(problem, targets, 1.0, local=jd.GradientDescent(), solver=two),
        lambda: jax.grad(lambda t: total(jd.deform(problem, t, 1.0)))(targets),
        lambda: jax.grad(lambda t: total(jd.deform(problem, t, 1.0, solver=two)))(targets),
        lambda: jax.vmap(lambda r: total(jd.deform(problem, targets, r)))(jnp.ones(3, "f4")),
        lambda: jd.energy(problem, points, jnp.broadcast_to(jnp.eye(3), (len(points), 3, 3)), 1.0),
        lambda: jd.laplacian_editing(bar, handles, bar.vertices[handles]),
        lambda: jd.linear_blend_skinning(points, weights, transforms),
        lambda: jd.dual_quaternion_skinning(points, weights, transforms),
    ]
    highest = (jax.lax.Precision.HIGHEST,) * 2
    seen = 0
    for function in functions:
        for equation in products(jax.make_jaxpr(function)().jaxpr):
            seen += 1
            assert equation.params["precision"] == highest, equation
    assert seen > 20
