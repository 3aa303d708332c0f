"""Eq. 4.4 and its constant objects against a double loop, and the scatter against its adjoint."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, ends, real_mesh
from jaxdeform.energy import stiffness

import jaxdeform as jd


def reach(mesh, k, r):
    """Breadth-first search, as the thesis says (Sec. 2.3)."""
    seen = {k}
    for _ in range(r):
        seen |= {int(j) for e in mesh.edges for i, j in (e, e[::-1]) if i in seen}
    return seen


def brute_cells(mesh, r):
    """E(k, r_k) as lists of edge numbers."""
    out = []
    for k in range(mesh.n_vertices):
        inside = reach(mesh, k, int(r[k]))
        out.append([e for e, (i, j) in enumerate(mesh.edges) if i in inside and j in inside])
    return out


def small_mesh():
    """An octahedron with one face subdivided: 7 vertices, several valences."""
    v = np.array(
        [
            [1, 0, 0],
            [-1, 0, 0.1],
            [0, 1.2, 0],
            [0, -1, 0],
            [0, 0.1, 1],
            [0, 0, -0.8],
            [0.4, 0.5, 0.4],
        ]
    )
    f = [[4, 0, 6], [0, 2, 6], [2, 4, 6], [4, 2, 1], [4, 1, 3], [4, 3, 0], [5, 2, 0], [5, 1, 2]]
    return jd.Mesh(v, [*f, [5, 3, 1], [5, 0, 3]])


MESHES = {
    "octahedron": small_mesh,
    "square": jd.shapes.square,
    "fan": lambda: real_mesh("fan3.obj"),
    "hourglass": lambda: real_mesh("hourglass_ico.obj"),
}


@pytest.fixture(params=MESHES)
def case(request):
    mesh = MESHES[request.param]()
    rng = np.random.default_rng(0)
    n = mesh.n_vertices
    return mesh, rng.integers(1, 4, n), rng.normal(size=(n, 3)), rng.normal(size=(n, 3, 3)), rng


def test_rings_are_the_breadth_first_search(case):
    mesh, r, *_ = case
    cells = jd.rings(mesh, r)
    found = [cells.membership[k].indices.tolist() for k in range(mesh.n_vertices)]
    assert found == brute_cells(mesh, r)


def test_spokes_are_the_edges_at_the_vertex(case):
    mesh = case[0]
    cells = jd.spokes(mesh)
    for k in range(mesh.n_vertices):
        want = [e for e, edge in enumerate(mesh.edges) if k in edge]
        assert cells.membership[k].indices.tolist() == want


def test_energy_is_the_double_sum(case):
    mesh, r, p, t, rng = case
    cells = jd.rings(mesh, r)
    lam = rng.random(mesh.n_vertices)
    total = 0.0
    for k, edges in enumerate(brute_cells(mesh, r)):
        for e in edges:
            i, j = mesh.edges[e]
            residual = (p[i] - p[j]) - t[k] @ (mesh.vertices[i] - mesh.vertices[j])
            total += cells.weights[e] * residual @ residual
        total += lam[k] * np.sum((t[k].T @ t[k] - np.eye(3)) ** 2)
    problem = jd.precompute(mesh, np.arange(mesh.n_vertices), cells=cells)
    np.testing.assert_allclose(jd.energy(problem, p, t, lam), total, rtol=EXACT)


def test_b_c_a_and_k_are_their_sums(case):
    mesh, r, p, t, _ = case
    n = mesh.n_vertices
    cells = jd.rings(mesh, r)
    problem = jd.precompute(mesh, np.arange(n), cells=cells)
    system = problem.system
    q = np.moveaxis(np.asarray(system.frames), -1, 0)
    b = np.zeros((n, 3, 3))
    c = np.zeros((n, 3, 3))
    right = np.zeros((n, 3))
    a = np.zeros((n, n))
    for k, edges in enumerate(brute_cells(mesh, r)):
        for e in edges:
            i, j = mesh.edges[e]
            rest, moved, w = mesh.vertices[i] - mesh.vertices[j], p[i] - p[j], cells.weights[e]
            b[k] += w * np.outer(rest, rest)
            c[k] += w * np.outer(rest, moved)
            right[i] += w * t[k] @ rest
            right[j] -= w * t[k] @ rest
            a[[i, j, i, j], [i, j, j, i]] += w * np.array([1, 1, -1, -1])
    diagonal = np.moveaxis(np.asarray(system.b), -1, 0)
    np.testing.assert_allclose(np.einsum("kai,ki,kbi->kab", q, diagonal, q), b, atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(q), 1.0, rtol=EXACT)
    found = np.moveaxis(np.asarray(system.scatter(jnp.asarray(p.T))), -1, 0)
    np.testing.assert_allclose(q @ found, c, atol=EXACT)
    framed = np.moveaxis(t @ q, 0, -1)
    np.testing.assert_allclose(system.scatter.adjoint(jnp.asarray(framed)).T, right, atol=EXACT)
    np.testing.assert_allclose(stiffness(cells).toarray(), a, atol=EXACT)
    np.testing.assert_allclose(system.stiffness.apply(jnp.asarray(p.T)).T, a @ p, atol=EXACT)


@pytest.mark.parametrize("name", ["cylinder", "bar"])
def test_scatter_and_adjoint_are_adjoint(name):
    """Also with overflow rows: the cylinder's poles have valence 40."""
    mesh = getattr(jd.shapes, name)()
    system = jd.precompute(mesh, [0]).system
    rng = np.random.default_rng(1)
    x, y = (jnp.asarray(rng.normal(size=(*s, mesh.n_vertices))) for s in ((3,), (3, 3)))
    left = jnp.sum(system.scatter(x) * jnp.swapaxes(y, 0, 1))
    np.testing.assert_allclose(left, jnp.sum(x * system.scatter.adjoint(y)), rtol=EXACT)
    _, pull = jax.vjp(system.scatter, x)
    np.testing.assert_allclose(
        pull(jnp.swapaxes(y, 0, 1))[0], system.scatter.adjoint(y), atol=EXACT
    )
    batch = jax.vmap(system.scatter)(jnp.stack([x, 2.0 * x]))
    np.testing.assert_allclose(batch[1], 2.0 * system.scatter(x), atol=EXACT)
    _, tangent = jax.jvp(system.scatter, (x,), (x,))
    np.testing.assert_allclose(tangent, system.scatter(x), atol=EXACT)


@pytest.mark.parametrize("name", ["cylinder", "bar"])
def test_lanes_side_by_side_are_every_lane_alone(name):
    mesh = getattr(jd.shapes, name)()
    system = jd.precompute(mesh, [0]).system
    rng = np.random.default_rng(3)
    n = mesh.n_vertices
    p, t = (jnp.asarray(rng.normal(size=(5, *s, n))) for s in ((3,), (3, 3)))
    products = (
        (system.scatter, p),
        (system.scatter.adjoint, t),
        (system.stiffness.apply, p),
    )
    for product, x in products:
        alone = np.stack([product(lane) for lane in x], axis=-1)
        flat = jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], n * 5)
        together = product(flat, 5)
        np.testing.assert_allclose(together.reshape(alone.shape), alone, atol=EXACT)
        under_vmap = jax.vmap(lambda k, x=flat, f=product: f(k * x, 5))(jnp.array([1.0, -2.0]))
        np.testing.assert_allclose(under_vmap[1], -2.0 * together, atol=EXACT)


def test_cotangent_weights_are_libigls():
    mesh = jd.shapes.cactus()
    matrix = igl.cotmatrix(mesh.vertices, mesh.faces).tocsr()
    want = np.asarray(matrix[mesh.edges[:, 0], mesh.edges[:, 1]]).ravel()
    np.testing.assert_allclose(jd.cotangent_weights(mesh), want, atol=1e-8)
    huge = jd.Mesh(mesh.vertices * 1e120, mesh.faces)
    np.testing.assert_allclose(jd.cotangent_weights(huge), want, atol=1e-8)


def test_material_is_free_of_scale(bar):
    handles = ends(bar)
    one = jd.rigidity_from_material(jd.precompute(bar, handles), 0.3)
    ten = jd.rigidity_from_material(
        jd.precompute(jd.Mesh(10 * bar.vertices, bar.faces), handles), 0.3
    )
    np.testing.assert_allclose(ten, 100 * one, rtol=EXACT)


def test_material_measures_area():
    """At r = 2 the centre's cell is the whole square, whose area is 4."""
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [0], cells=jd.rings(mesh, 2))
    np.testing.assert_allclose(jd.rigidity_from_material(problem, 1.0)[4], 4.0, rtol=EXACT)


def test_rows_that_negative_weights_make_indefinite_are_lifted():
    mesh = real_mesh("octopus_10173.off")
    signed = jd.cotangent_weights(mesh)
    assert (signed < 0).any()
    cells = jd.rings(mesh, 1)
    problem = jd.precompute(mesh, [0], cells=cells)
    assert float(problem.system.b.min()) > -1e-9
    changed = np.flatnonzero(cells.weights != signed)
    assert 0 < len(changed) < 200
    assert (signed[changed] < 0).all()


def test_energy_gradient_by_differences(bar, bar_problem):
    rng = np.random.default_rng(2)
    p = jnp.asarray(bar.vertices + rng.normal(size=bar.vertices.shape))
    t = jnp.asarray(np.eye(3) + 0.1 * rng.normal(size=(722, 3, 3)))
    f = lambda p: jd.energy(bar_problem, p, t, 1.5)  # noqa: E731
    d = jnp.asarray(rng.normal(size=p.shape))
    h = 1e-5
    want = (f(p + h * d) - f(p - h * d)) / (2 * h)
    np.testing.assert_allclose(jnp.sum(jax.grad(f)(p) * d), want, rtol=FD)
