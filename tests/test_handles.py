"""Handle groups with six degrees of freedom, and handles that pull instead of holding."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import EXACT, FD
from scipy.spatial.transform import Rotation
from sheet import bumpy_sheet

import jaxdeform as jd

TIGHT = jd.QuasiNewton(tolerance=1e-15)


@pytest.fixture(scope="module")
def sheet():
    """A mesh, the handles at two of its sides, and where they go."""
    mesh = bumpy_sheet()
    handles = np.flatnonzero((mesh.vertices[:, 0] == 0) | (mesh.vertices[:, 0] == 7))
    return mesh, handles, np.asarray(jd.bend(mesh.vertices[handles], 60.0, along="x", toward="z"))


# ---------------------------------------------------------------- groups


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi, 5.0, 2 * np.pi])
def test_groups_turn_as_scipy_turns_them(angle):
    rng = np.random.default_rng(0)
    points, group = rng.normal(size=(20, 3)), rng.integers(0, 3, 20)
    axes = rng.normal(size=(3, 3))
    rotations = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    translations, centers = rng.normal(size=(2, 3, 3))
    middles = np.stack([points[group == g].mean(axis=0) for g in range(3)])
    for given, about in ((centers, centers), (None, middles)):
        got = jd.rigid_targets(points, group, rotations, translations, given)
        for g in range(3):
            turned = Rotation.from_rotvec(rotations[g]).apply(points[group == g] - about[g])
            want = turned + about[g] + translations[g]
            np.testing.assert_allclose(got[group == g], want, atol=EXACT)


def test_whole_numbers_are_positions_too():
    got = jd.rigid_targets([[1, 0, 0], [-1, 0, 0]], [0, 0], [[0, 0, np.pi / 2]], [[0, 0, 0.5]])
    np.testing.assert_allclose(got, [[0, 1, 0.5], [0, -1, 0.5]], atol=EXACT)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.7, np.pi])
def test_derivatives_of_groups_by_differences(angle):
    """First and second ones, at no rotation too."""
    rng = np.random.default_rng(1)
    points, goal = rng.normal(size=(2, 9, 3))
    group = np.repeat([0, 1], [4, 5])
    where = angle * np.array([[0.6, 0, 0.8], [0.0, 1, 0]])
    move, shift, shift_move = rng.normal(size=(3, 2, 3))

    @jax.jit
    def loss(rotations, translations):
        return jnp.sum((jd.rigid_targets(points, group, rotations, translations) - goal) ** 2)

    h = 1e-4
    ahead = loss(where + h * move, shift + h * shift_move)
    back = loss(where - h * move, shift - h * shift_move)
    slopes = jax.grad(loss, (0, 1))(jnp.asarray(where), jnp.asarray(shift))
    got = jnp.sum(slopes[0] * move) + jnp.sum(slopes[1] * shift_move)
    np.testing.assert_allclose(got, (ahead - back) / (2 * h), rtol=FD)
    line = lambda s: loss(where + s * move, shift + s * shift_move)  # noqa: E731
    curvature = (ahead - 2 * loss(where, shift) + back) / h**2
    np.testing.assert_allclose(jax.hessian(line)(0.0), curvature, rtol=FD)


def test_gradients_reach_the_groups_through_deform(sheet):
    mesh, handles, _ = sheet
    problem = jd.precompute(mesh, handles)
    group = (mesh.vertices[handles, 0] > 3).astype(int)
    rng = np.random.default_rng(2)
    goal = jnp.asarray(rng.normal(size=mesh.vertices.shape))
    turn, turn_move = np.array([[0, 0, 0], [0.2, 0.1, -0.5]]), rng.normal(size=(2, 3))
    shift, shift_move = np.array([[0, 0, 0], [0.5, -0.8, 0.2]]), rng.normal(size=(2, 3))

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def loss(rotations, translations):
        targets = jd.rigid_targets(mesh.vertices[handles], group, rotations, translations)
        # Rotations only: half the time to compile, and the targets enter in the same way.
        out = jd.deform(problem, targets, 0.0, local=jd.RotationFit(), solver=TIGHT)
        return jnp.sum(goal * out.vertices)

    h = 1e-4
    ahead, _ = loss(turn + h * turn_move, shift + h * shift_move)
    back, _ = loss(turn - h * turn_move, shift - h * shift_move)
    _, slopes = loss(jnp.asarray(turn, float), jnp.asarray(shift))
    got = jnp.sum(slopes[0] * turn_move) + jnp.sum(slopes[1] * shift_move)
    np.testing.assert_allclose(got, (ahead - back) / (2 * h), rtol=FD)


def bad_calls():
    points, group = np.eye(3), [0, 1, 0]
    two = np.zeros((2, 3))
    rigid = jd.rigid_targets
    return {
        "points have shape": lambda: rigid(points[0], group, two, two),
        "points of handle 1 are not finite": lambda: rigid(
            np.where(np.arange(3)[:, None] == 1, np.nan, points), group, two, two
        ),
        "rotations have shape": lambda: rigid(points, group, np.eye(2), two),
        "rotations of group 1 are not finite": lambda: rigid(
            points, group, [[0, 0, 0], [0, np.inf, 0]], two
        ),
        "translations have shape": lambda: rigid(points, group, two, two[:1]),
        "centers have shape": lambda: rigid(points, group, two, two, two[0]),
        "group has shape": lambda: rigid(points, group[:2], two, two),
        "type float64: give one integer": lambda: rigid(points, [0.0, 1.0, 0.0], two, two),
        "group 2 is out of range": lambda: rigid(points, [0, 1, 2], two, two),
        "the group of handle 1 is -1": lambda: rigid(points, [0, -1, 1], two, two),
    }


@pytest.mark.parametrize("message", bad_calls())
def test_bad_groups_get_a_clear_error(message):
    with pytest.raises(jd.InputError, match=message) as caught:
        bad_calls()[message]()
    assert "\n" not in str(caught.value)


def test_shapes_are_checked_while_tracing():
    with pytest.raises(jd.InputError, match="translations have shape"):
        jax.jit(lambda t: jd.rigid_targets(np.eye(3), [0, 1, 0], np.zeros((2, 3)), t))(np.eye(3))


# ---------------------------------------------------------------- soft handles


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
