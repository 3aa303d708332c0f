"""K, its transpose, A and B against their sums over edges."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD
from small_meshes import MESHES, brute_cells, random_case

import jaxdeform as jd
from jaxdeform._deformation.covariance import stiffness

pytestmark = pytest.mark.usefixtures("exact_sizes")


@pytest.fixture(params=MESHES)
def case(request):
    return random_case(request.param)


def test_b_c_a_and_k_are_their_sums(case):
    mesh, r, p, t, _ = case
    n = mesh.n_vertices
    cells = jd.rings(mesh, r)
    problem = jd.precompute(mesh, np.arange(n), cells=cells)
    system = problem.system
    q = np.moveaxis(np.asarray(system.principal_axes), -1, 0)
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
    diagonal = np.moveaxis(np.asarray(system.principal_moments), -1, 0)
    np.testing.assert_allclose(np.einsum("kai,ki,kbi->kab", q, diagonal, q), b, atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(q), 1.0, rtol=EXACT)
    found = np.moveaxis(np.asarray(system.covariance(jnp.asarray(p.T))), -1, 0)
    np.testing.assert_allclose(q @ found, c, atol=EXACT)
    framed = np.moveaxis(t @ q, 0, -1)
    np.testing.assert_allclose(
        system.covariance.transpose(jnp.asarray(framed)).T, right, atol=EXACT
    )
    np.testing.assert_allclose(stiffness(cells).toarray(), a, atol=EXACT)
    np.testing.assert_allclose(system.stiffness.apply(jnp.asarray(p.T)).T, a @ p, atol=EXACT)


@pytest.mark.parametrize("name", ["cylinder", "bar"])
def test_the_transpose_is_the_transpose(name):
    """Also with overflow rows: the cylinder's poles have valence 40."""
    mesh = getattr(jd.shapes, name)()
    system = jd.precompute(mesh, [0]).system
    rng = np.random.default_rng(1)
    x, y = (jnp.asarray(rng.normal(size=(*s, mesh.n_vertices))) for s in ((3,), (3, 3)))
    left = jnp.sum(system.covariance(x) * jnp.swapaxes(y, 0, 1))
    np.testing.assert_allclose(left, jnp.sum(x * system.covariance.transpose(y)), rtol=EXACT)
    _, pull = jax.vjp(system.covariance, x)
    np.testing.assert_allclose(
        pull(jnp.swapaxes(y, 0, 1))[0], system.covariance.transpose(y), atol=EXACT
    )
    batch = jax.vmap(system.covariance)(jnp.stack([x, 2.0 * x]))
    np.testing.assert_allclose(batch[1], 2.0 * system.covariance(x), atol=EXACT)
    _, tangent = jax.jvp(system.covariance, (x,), (x,))
    np.testing.assert_allclose(tangent, system.covariance(x), atol=EXACT)


@pytest.mark.parametrize("name", ["cylinder", "bar"])
def test_a_batch_side_by_side_is_every_member_alone(name):
    mesh = getattr(jd.shapes, name)()
    system = jd.precompute(mesh, [0]).system
    rng = np.random.default_rng(3)
    n = mesh.n_vertices
    p, t = (jnp.asarray(rng.normal(size=(5, *s, n))) for s in ((3,), (3, 3)))
    products = (
        (system.covariance, p),
        (system.covariance.transpose, t),
        (system.stiffness.apply, p),
    )
    for product, x in products:
        alone = np.stack([product(member) for member in x], axis=-1)
        flat = jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], n * 5)
        together = product(flat, 5)
        np.testing.assert_allclose(together.reshape(alone.shape), alone, atol=EXACT)
        under_vmap = jax.vmap(lambda k, x=flat, f=product: f(k * x, 5))(jnp.array([1.0, -2.0]))
        np.testing.assert_allclose(under_vmap[1], -2.0 * together, atol=EXACT)


def test_derivatives_to_its_numbers_by_differences():
    """Both matrices are functions of one parameter; C and K^T T each count their own."""
    mesh = jd.shapes.square()
    k = jd.precompute(mesh, [0]).system.covariance
    p = jnp.asarray(np.random.default_rng(4).normal(size=(3, mesh.n_vertices)))

    @jax.jit
    def f(scale):
        numbers, pattern = eqx.partition(k, eqx.is_inexact_array)
        scaled = eqx.combine(jax.tree.map(lambda x: x * jnp.exp(scale), numbers), pattern)
        return jnp.sum(scaled.transpose(jnp.sin(scaled(p))) ** 2)

    h = 1e-5
    want = (f(0.2 + h) - f(0.2 - h)) / (2.0 * h)
    np.testing.assert_allclose(jax.grad(f)(0.2), want, rtol=FD)
    np.testing.assert_allclose(jax.jacfwd(f)(0.2), want, rtol=FD)
