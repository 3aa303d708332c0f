"""Soft handles: forces, limits, derivatives to their weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, TIGHT, held_sheet

import jaxdeform as jd


@pytest.fixture(scope="module")
def sheet():
    return held_sheet()


@pytest.fixture(scope="module")
def mixed(sheet):
    """Hard at one side, soft at the other, each with a weight of its own."""
    mesh, handles, _ = sheet
    soft = mesh.vertices[handles, 0] > 3
    pull = np.random.default_rng(3).uniform(0.1, 1.0, len(handles))
    return jd.precompute(mesh, handles, handle_weights=np.where(soft, pull, np.inf)), soft, pull


def test_a_soft_handle_balances_the_forces(sheet, mixed):
    """At the minimum the mesh pulls back as hard as the handle pulls: grad E = -2 w (p' - u)."""
    (problem, soft, pull), (mesh, handles, targets) = mixed, sheet
    out = jd.deform(problem, targets, 0.3, solver=TIGHT)
    at = handles[soft]
    slack = np.asarray(out.vertices)[at] - targets[soft]
    assert np.abs(slack).max() > 0.1
    np.testing.assert_allclose(out.vertices[handles[~soft]], targets[~soft], atol=EXACT)
    force = jax.grad(lambda p: jd.energy(problem, p, out.transforms, 0.3))(out.vertices)
    pulls = np.zeros(mesh.vertices.shape)
    pulls[at] = -2 * pull[soft, None] * slack
    free = np.setdiff1d(np.arange(mesh.n_vertices), handles[~soft])
    # The solver stops by the energy, whose square root the force is.
    np.testing.assert_allclose(force[free], pulls[free], atol=1e-6 * np.abs(pulls).max())
    total = jd.energy(problem, out.vertices, out.transforms, 0.3)
    total = total + np.sum(pull[soft, None] * slack**2)
    np.testing.assert_allclose(out.energy[-1], total, rtol=1e-9)


def test_targets_far_away_are_followed(sheet):
    """A move of the whole by 50 diagonals strains nothing, with soft handles as with hard ones."""
    mesh, handles, _ = sheet
    move = 50.0 * mesh.diagonal
    problem = jd.precompute(mesh, handles, handle_weights=10.0)
    out = jd.deform(problem, mesh.vertices[handles] + move, 1.0)
    assert out.result == jd.Result.converged
    np.testing.assert_allclose(out.vertices, mesh.vertices + move, atol=1e-10 * move)


def test_a_weight_of_zero_is_no_handle(sheet, mixed):
    (_, soft, _), (mesh, handles, targets) = mixed, sheet
    idle = jd.precompute(mesh, handles, handle_weights=np.where(soft, 0.0, np.inf))
    without = jd.precompute(mesh, handles[~soft])
    got = jd.deform(idle, targets, 0.3, start=mesh.vertices, solver=TIGHT).vertices
    want = jd.deform(without, targets[~soft], 0.3, start=mesh.vertices, solver=TIGHT).vertices
    np.testing.assert_allclose(got, want, atol=1e-7)


@pytest.mark.parametrize(
    ("solver", "adjoint"), [(TIGHT, jd.Implicit()), (jd.Alternating(25), jd.Unrolled())]
)
def test_gradients_to_soft_targets_by_differences(sheet, mixed, solver, adjoint):
    (problem, _, _), (mesh, _, targets) = mixed, sheet
    rng = np.random.default_rng(4)
    goal, move = rng.normal(size=mesh.vertices.shape), rng.normal(size=targets.shape)

    @jax.jit
    @jax.value_and_grad  # one compilation for values and gradients
    def loss(targets):
        out = jd.deform(
            problem, targets, 0.0, local=jd.RotationFit(), solver=solver, adjoint=adjoint
        )
        return jnp.sum(goal * out.vertices)

    h = 1e-4
    want = (loss(targets + h * move)[0] - loss(targets - h * move)[0]) / (2 * h)
    np.testing.assert_allclose(jnp.sum(loss(targets)[1] * move), want, rtol=FD)


def test_the_energy_answers_to_a_weight_by_the_squared_distance(sheet, mixed):
    """dE/dw = |p' - u|^2, because the shape is a minimum: what a larger weight would cost."""
    (problem, soft, pull), (mesh, handles, targets) = mixed, sheet
    out = jd.deform(problem, targets, 0.3, solver=TIGHT)
    k = int(np.flatnonzero(soft)[2])
    gap = float(np.sum((out.vertices[handles[k]] - targets[k]) ** 2))
    h, energies = 1e-3 * pull[k], []
    for sign in (1, -1):
        weights = np.where(soft, pull, np.inf)
        weights[k] += sign * h
        other = jd.precompute(mesh, handles, handle_weights=weights)
        energies.append(float(jd.deform(other, targets, 0.3, solver=TIGHT).energy[-1]))
    np.testing.assert_allclose((energies[0] - energies[1]) / (2 * h), gap, rtol=FD)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (-1.0, "weight of handle 0 is -1"),
        (np.nan, "weight of handle 0 is nan"),
        ([1.0, 1.0], "handle_weights have shape"),
        (0.0, "no handle"),
    ],
)
def test_bad_handle_weights_get_a_clear_error(sheet, weights, message):
    with pytest.raises(jd.InputError, match=message):
        jd.precompute(sheet[0], [0, 1, 2], handle_weights=weights)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "local"),
    [(TIGHT, jd.Newton()), (jd.Alternating(25), jd.RotationFit())],
)
def test_derivatives_to_the_weights_of_soft_handles(sheet, solver, local):
    mesh, handles, targets = sheet
    soft = mesh.vertices[handles, 0] > 3
    problem = jd.precompute(mesh, handles, handle_weights=np.where(soft, 1.0, np.inf))
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.1, 0.9, len(handles))
    goal, along = rng.normal(size=mesh.vertices.shape), weights * rng.normal(size=len(handles))

    @jax.jit
    def loss(w):
        out = jd.deform(problem, targets, 0.3, handle_weights=w, solver=solver, local=local)
        return jnp.sum(goal * out.vertices)

    h = 1e-4
    want = (loss(weights + h * along) - loss(weights - h * along)) / (2 * h)
    gradient = jax.grad(loss)(jnp.asarray(weights))
    np.testing.assert_allclose(jnp.sum(gradient * along), want, rtol=FD)
    assert not np.any(gradient[~soft])  # a hard handle has no weight to change


def test_other_weights_are_those_of_a_new_factorisation(sheet):
    mesh, handles, targets = sheet
    weights = np.random.default_rng(1).uniform(0.1, 0.9, len(handles))
    loose = jd.precompute(mesh, handles, handle_weights=1.0)
    anew = jd.precompute(mesh, handles, handle_weights=weights)
    found = jd.deform(loose, targets, 0.3, handle_weights=weights, solver=TIGHT).vertices
    want = jd.deform(anew, targets, 0.3, solver=TIGHT).vertices
    np.testing.assert_allclose(found, want, atol=1e-6)
    with pytest.raises(jd.InputError, match=r"the weight of handle \d+ is 2"):
        jd.deform(loose, targets, 0.3, handle_weights=2.0)
    with pytest.raises(jd.InputError, match="handle_weights have shape"):
        jd.deform(loose, targets, 0.3, handle_weights=weights[:-1])
