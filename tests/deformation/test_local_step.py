"""The local step: every solver against first principles, per cell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD
from minima import ALL, fit, name
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import jaxdeform as jd
from jaxdeform._linalg.rotations import polar_rotation


def cells(strain, n=200, seed=0, flat=False):
    """Random cells: C = B (I + strain) R^T, so that T is near a rotation R stretched a little."""
    rng = np.random.default_rng(seed)
    b = rng.uniform(0.2, 1.0, (n, 3))
    if flat:
        b[:, 0] = 0.0
    r = Rotation.random(n, rng=rng).as_matrix()
    stretch = np.eye(3) + strain * rng.normal(size=(n, 3, 3))
    c = np.einsum("ni,nij,nkj->nik", b, stretch, r)
    lam = 10 ** rng.uniform(-3, 2, n)
    return jnp.asarray(np.moveaxis(c, 0, -1)), jnp.asarray(b.T), jnp.asarray(lam)


def phi(t, c, b, lam):
    t = np.reshape(t, (3, 3))
    return (
        lam * np.sum((t.T @ t - np.eye(3)) ** 2)
        + np.trace(t @ np.diag(b) @ t.T)
        - 2 * np.trace(t @ c)
    )


@pytest.mark.parametrize("strain", [0.02, 0.2, 0.5])
def test_newton_finds_the_minimum_that_scipy_finds(strain):
    c, b, lam = cells(strain, n=40)
    t = np.asarray(fit(jd.Newton(), c, b, lam))
    start = np.asarray(polar_rotation(c))
    for k in range(40):
        args = (np.asarray(c[..., k]), np.asarray(b[:, k]), float(lam[k]))
        best = minimize(phi, start[..., k].ravel(), args, method="BFGS", options={"gtol": 1e-9})
        assert phi(t[..., k], *args) <= best.fun + 1e-8 * (1 + abs(best.fun))


def test_no_solver_raises_the_energy():
    c, b, lam = cells(0.8)
    start = np.asarray(polar_rotation(c))
    for local in (jd.GradientDescent(max_steps=3), jd.Newton(), jd.LBFGS()):
        t = np.asarray(fit(local, c, b, lam))
        for k in range(200):
            args = (np.asarray(c[..., k]), np.asarray(b[:, k]), float(lam[k]))
            assert phi(t[..., k], *args) <= phi(start[..., k], *args) + 1e-12


def test_polar_rotation_is_the_best_proper_rotation():
    rng = np.random.default_rng(3)
    c = rng.normal(size=(500, 3, 3))
    r = np.moveaxis(np.asarray(polar_rotation(jnp.asarray(np.moveaxis(c, 0, -1)))), -1, 0)
    u, _, vt = np.linalg.svd(c)
    sign = np.sign(np.linalg.det(u @ vt))
    want = np.einsum("nji,nj,nkj->nik", vt, np.stack([sign**0, sign**0, sign], 1), u)
    np.testing.assert_allclose(r, want, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, rtol=EXACT)
    np.testing.assert_allclose(
        r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=EXACT
    )


@pytest.mark.parametrize("scale", [0.0, 1e-150, 1.0, 1e120])
def test_degenerate_cells_give_a_proper_rotation(scale):
    """Empty, collapsed to a line, collapsed to a plane, exactly symmetric."""
    ranks = np.array([np.zeros((3, 3)), np.diag([1.0, 0, 0]), np.diag([0, 1.0, 1]), np.eye(3)])
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    c = jnp.asarray(np.moveaxis(scale * np.concatenate([ranks, ranks @ turn]), 0, -1))
    r = np.moveaxis(np.asarray(polar_rotation(c)), -1, 0)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, rtol=EXACT)
    np.testing.assert_allclose(
        r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=EXACT
    )
    if scale == 0.0:
        np.testing.assert_allclose(r, np.broadcast_to(np.eye(3), r.shape), atol=EXACT)


def test_affine_fit_recovers_the_linear_map():
    rng = np.random.default_rng(4)
    b = rng.uniform(0.5, 2.0, (50, 3))
    t = np.eye(3) + 0.3 * rng.normal(size=(50, 3, 3))
    c = np.einsum("ni,nji->nij", b, t)
    found = fit(jd.AffineFit(), jnp.asarray(np.moveaxis(c, 0, -1)), jnp.asarray(b.T), jnp.zeros(50))
    # It leans on the rotation by 2e-13 of the cell's size, for the sake of flat cells.
    np.testing.assert_allclose(np.moveaxis(np.asarray(found), -1, 0), t, atol=1e-9)


@pytest.mark.parametrize("local", [jd.Newton(), jd.LBFGS(), jd.RotationFit(), jd.AffineFit()])
def test_derivatives_by_differences(local):
    c, b, lam = cells(0.2, n=30)
    rng = np.random.default_rng(5)
    dc, dlam = jnp.asarray(rng.normal(size=c.shape)), jnp.asarray(rng.normal(size=lam.shape)) * lam
    _, tangent = jax.jvp(lambda c, lam: fit(local, c, b, lam), (c, lam), (dc, dlam))
    h = 1e-5
    upper = fit(local, c + h * dc, b, lam + h * dlam)
    lower = fit(local, c - h * dc, b, lam - h * dlam)
    difference = (upper - lower) / (2 * h)
    np.testing.assert_allclose(tangent, difference, atol=FD * float(jnp.abs(difference).max()))
    weight = jnp.asarray(rng.normal(size=c.shape))
    _, pull = jax.vjp(lambda c, lam: fit(local, c, b, lam), c, lam)
    gc, glam = pull(weight)
    both = jnp.sum(gc * dc) + jnp.sum(glam * dlam)
    np.testing.assert_allclose(both, jnp.sum(weight * tangent), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("local", [jd.Newton(), jd.RotationFit(), jd.AffineFit()], ids=name)
def test_second_derivatives_are_the_differences_of_the_first(local):
    """In all orders of forward and reverse, at a known minimum. LBFGS has the rules of Newton."""
    c, b, lam = cells(0.2, n=30)
    rng = np.random.default_rng(5)
    dc, weight = (jnp.asarray(rng.normal(size=c.shape)) for _ in range(2))

    def loss(x, known=None):
        data = c + x[0] * dc, b, lam * jnp.exp(x[1])
        t = fit(local, *data) if known is None else local.with_implicit_derivative(known, *data)
        return jnp.sum(weight * t**2)

    slope, h, at = jax.jit(jax.grad(loss)), 1e-5, jnp.zeros(2)
    numeric = np.stack([(slope(at + h * d) - slope(at - h * d)) / (2 * h) for d in jnp.eye(2)])
    known = fit(local, c, b, lam)
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            found = jax.jit(outer(inner(loss)))(at, known)
            np.testing.assert_allclose(found, numeric, atol=FD * np.abs(numeric).max())


@pytest.mark.parametrize("local", ALL, ids=name)
def test_not_a_number_stays_in_its_cell(local):
    c, b, lam = cells(0.1)
    t = fit(local, c.at[0, 0, 7].set(jnp.nan), b, lam)
    good = np.delete(np.arange(200), 7)
    np.testing.assert_allclose(t[..., good], fit(local, c, b, lam)[..., good], atol=1e-9)
