"""Derivatives through a deformation, by differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FD, ends, held_sheet

import jaxdeform as jd


@pytest.mark.parametrize(
    ("solver", "adjoint"),
    [
        (jd.Alternating(30), jd.Unrolled()),
        pytest.param(jd.Alternating(2000), jd.Implicit(), marks=pytest.mark.slow),
        (jd.QuasiNewton(tolerance=1e-15), jd.Implicit()),
    ],
)
def test_derivatives_by_differences(bar_problem, bar_targets, solver, adjoint):
    rng = np.random.default_rng(3)
    weight = jnp.asarray(rng.normal(size=(722, 3)))
    lam = jnp.asarray(rng.uniform(0.5, 5.0, 722))
    targets = jnp.asarray(bar_targets)
    dlam, dtargets = lam * rng.normal(size=722), jnp.asarray(rng.normal(size=targets.shape))

    def loss(targets, lam):
        out = jd.deform(bar_problem, targets, lam, solver=solver, adjoint=adjoint)
        return jnp.sum(weight * out.vertices) + jnp.sum(out.transforms**2) + out.energy[-1]

    loss = jax.jit(loss)
    h = 1e-4
    want = loss(targets + h * dtargets, lam + h * dlam) - loss(
        targets - h * dtargets, lam - h * dlam
    )
    want = float(want) / (2 * h)
    _, forward = jax.jvp(loss, (targets, lam), (dtargets, dlam))
    np.testing.assert_allclose(forward, want, rtol=FD)
    gt, gl = jax.grad(loss, (0, 1))(targets, lam)
    np.testing.assert_allclose(jnp.sum(gt * dtargets) + jnp.sum(gl * dlam), want, rtol=FD)


@pytest.mark.slow
def test_sparse_factor_under_jit_vmap_grad():
    """Above 1000 vertices the factor is on the host: the same must hold there."""
    mesh = jd.shapes.cylinder()
    handles = ends(mesh)
    problem = jd.precompute(mesh, handles)
    targets = jnp.asarray(jd.bend(mesh.vertices[handles], 30.0))
    solver = jd.Alternating(4)
    loss = lambda r: jnp.sum(jd.deform(problem, targets, r, solver=solver).vertices ** 2)  # noqa: E731
    batch = jax.jit(jax.vmap(jax.value_and_grad(loss)))(jnp.asarray([0.01, 0.1]))
    for k, r in enumerate((0.01, 0.1)):
        h = 1e-4 * r
        np.testing.assert_allclose(batch[0][k], loss(r), rtol=1e-9)
        np.testing.assert_allclose(batch[1][k], (loss(r + h) - loss(r - h)) / (2 * h), rtol=FD)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("local", "solver"),
    [
        (jd.Newton(), jd.QuasiNewton(tolerance=1e-15)),
        (jd.Newton(), jd.Alternating(20)),
        (jd.RotationFit(), jd.QuasiNewton(tolerance=1e-15)),
    ],
    ids=["implicit", "unrolled", "rotation"],
)
def test_second_derivatives_are_the_differences_of_the_first(local, solver):
    """To the height of a target and the logarithm of the rigidity; forward over reverse."""
    mesh, handles, targets = held_sheet()
    problem = jd.precompute(mesh, handles)
    upper = jnp.asarray((targets[:, 2] > 0).astype(float))[:, None] * jnp.eye(3)[2][None]

    def loss(x):
        moved = jnp.asarray(targets) + x[0] * upper
        out = jd.deform(problem, moved, jnp.exp(x[1]), local=local, solver=solver)
        return jnp.sum(out.vertices**2) + out.energy[-1]

    slope = jax.jit(jax.grad(loss))
    x, h = jnp.asarray([0.2, -0.5]), 1e-4
    numeric = np.stack([(slope(x + h * d) - slope(x - h * d)) / (2 * h) for d in jnp.eye(2)])
    # Reverse mode splits a scan into what is known and what is linear, and JAX drops custom rules
    # of the known part. So the unrolled loop gives second derivatives by forward mode alone.
    unrolled = isinstance(solver, jd.Alternating)
    hessian = jax.jacfwd(jax.jacfwd(loss)) if unrolled else jax.hessian(loss)
    found = jax.jit(hessian)(x)
    np.testing.assert_allclose(found, numeric, rtol=FD, atol=FD * np.abs(numeric).max())
