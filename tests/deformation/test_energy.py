"""Eq. 4.4 and what it is made of, against a double loop."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, ends
from small_meshes import MESHES, brute_cells, random_case

import jaxdeform as jd


@pytest.fixture(params=MESHES)
def case(request):
    return random_case(request.param)


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


def test_energy_gradient_by_differences(bar, bar_problem):
    rng = np.random.default_rng(2)
    p = jnp.asarray(bar.vertices + rng.normal(size=bar.vertices.shape))
    t = jnp.asarray(np.eye(3) + 0.1 * rng.normal(size=(722, 3, 3)))
    f = lambda p: jd.energy(bar_problem, p, t, 1.5)  # noqa: E731
    d = jnp.asarray(rng.normal(size=p.shape))
    h = 1e-5
    want = (f(p + h * d) - f(p - h * d)) / (2 * h)
    np.testing.assert_allclose(jnp.sum(jax.grad(f)(p) * d), want, rtol=FD)
