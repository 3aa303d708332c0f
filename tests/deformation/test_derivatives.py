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
        pytest.param(jd.QuasiNewton(tolerance=1e-15), jd.Implicit(), marks=pytest.mark.slow),
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


def _held_loss(local, solver):
    """Of the height of a target and the logarithm of the rigidity."""
    mesh, handles, targets = held_sheet()
    problem = jd.precompute(mesh, handles)
    upper = jnp.asarray((targets[:, 2] > 0).astype(float))[:, None] * jnp.eye(3)[2][None]

    def loss(x):
        moved = jnp.asarray(targets) + x[0] * upper
        out = jd.deform(problem, moved, jnp.exp(x[1]), local=local, solver=solver)
        return jnp.sum(out.vertices**2) + out.energy[-1]

    return loss


def descent(tolerance):
    """Without the look for saddles, which takes half the time of compilation."""
    return jd.QuasiNewton(tolerance=tolerance, max_steps=3000, leave_saddles=False)


LAWS = {"material": jd.Newton(), "rotation": jd.RotationFit(), "affine": jd.AffineFit()}
AT = jnp.asarray([0.2, -0.5])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "solver"),
    [
        *[pytest.param(law, descent(1e-12), id=f"{law}-implicit") for law in LAWS],
        pytest.param("material", jd.Alternating(20), id="material-unrolled"),
    ],
)
def test_second_derivatives_are_the_differences_of_the_first(law, solver):
    """Of a loss of degree two, which holds the vertices: these are as exact as the state.

    In all orders of forward and reverse for the implicit ones of the material, forward over reverse
    for the others; test_local_step.py has all orders of all laws, without the rest.
    """
    tight = descent(1e-16) if isinstance(solver, jd.QuasiNewton) else solver
    slope, h = jax.jit(jax.grad(_held_loss(LAWS[law], tight))), 1e-4
    numeric = np.stack([(slope(AT + h * d) - slope(AT - h * d)) / (2 * h) for d in jnp.eye(2)])
    loss = _held_loss(LAWS[law], solver)
    found = jax.jit(jax.hessian(loss))(AT)
    np.testing.assert_allclose(found, numeric, rtol=FD, atol=FD * np.abs(numeric).max())
    implicit = isinstance(solver, jd.QuasiNewton)
    others = [(jax.jacfwd, jax.jacfwd), (jax.jacrev, jax.jacfwd), (jax.jacrev, jax.jacrev)]
    for outer, inner in others if law == "material" and implicit else ():
        np.testing.assert_allclose(jax.jit(outer(inner(loss)))(AT), found, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_through_a_scan_are_the_differences_of_the_first():
    """Of a loss that is quadratic in all of the solution. JAX drops custom rules in such a scan.

    Forward over reverse; test_sr_arap.py has reverse over reverse, by the same means.
    """
    mesh, handles, targets = held_sheet()
    problem = jd.precompute(mesh, handles)
    solver = descent(1e-14)

    def loss(x):
        def deform_from(start, part):
            targets_now = (1.0 + part * x[0]) * jnp.asarray(targets)
            rigidity = jnp.exp(part * x[1])
            out = jd.deform(problem, targets_now, rigidity, start=start, solver=solver)
            squares = jnp.sum(out.vertices**2) + jnp.sum(out.transforms**2) + out.energy[-1] ** 2
            return out.vertices, squares

        parts = jnp.asarray([0.5, 1.0])
        return jnp.sum(jax.lax.scan(deform_from, jnp.asarray(mesh.vertices), parts)[1])

    slope, h = jax.jit(jax.grad(loss)), 1e-4
    numeric = np.stack([(slope(AT + h * d) - slope(AT - h * d)) / (2 * h) for d in jnp.eye(2)])
    found = jax.jit(jax.hessian(loss))(AT)
    np.testing.assert_allclose(found, numeric, rtol=FD, atol=FD * np.abs(numeric).max())


@pytest.mark.slow
def test_a_gradient_is_right_at_every_tolerance(bar, bar_problem, bar_targets, halves):
    """Or NaN. One Newton step from the default state alone is up to 5 % off, of stiff halves."""
    weight = jnp.asarray(np.random.default_rng(0).normal(size=bar.vertices.shape))
    half = jnp.asarray(halves > 0)

    def slope(solver):
        def loss(x):
            rigidity = jnp.where(half, jnp.exp(x[1]), jnp.exp(x[0]))
            return jnp.sum(
                weight * jd.deform(bar_problem, bar_targets, rigidity, solver=solver).vertices
            )

        return jax.jit(jax.grad(loss))

    slopes = [slope(descent(tolerance)) for tolerance in (1e-15, jd.QuasiNewton().tolerance, 1e-2)]
    size = float(np.mean(jd.rigidity_from_material(bar_problem, 1.0)))
    found = 0
    for materials in ([0.01, 1.0], [0.1, 0.1], [3.0, 30.0]):
        exact, usual, loose = (f(jnp.log(size * jnp.asarray(materials))) for f in slopes)
        np.testing.assert_allclose(usual, exact, rtol=1e-5, atol=1e-5 * np.abs(exact).max())
        if np.isfinite(loose).all():
            found += 1
            np.testing.assert_allclose(loose, exact, rtol=1e-4, atol=1e-4 * np.abs(exact).max())
    assert found >= 2


@pytest.mark.slow
def test_an_unsolved_linear_system_gives_nan_or_raises(bar_problem, bar_targets):
    def slope(adjoint):
        def loss(r):
            out = jd.deform(bar_problem, bar_targets, r, adjoint=adjoint)
            return jnp.sum(out.vertices**2)

        return jax.grad(loss)(0.3)

    assert np.isnan(slope(jd.Implicit(max_steps=1)))
    with pytest.raises(Exception, match="conjugate gradients did not solve their"):
        slope(jd.Implicit(max_steps=1, throw=True))
