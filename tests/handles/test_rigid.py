"""Handle groups that move rigidly."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, TIGHT, held_sheet
from scipy.spatial.transform import Rotation

import jaxdeform as jd


@pytest.fixture(scope="module")
def sheet():
    return held_sheet()


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
        "group must be integers, got float64: give one integer": lambda: rigid(
            points, [0.0, 1.0, 0.0], two, two
        ),
        "the group of handle 2 is 2, out of range": lambda: rigid(points, [0, 1, 2], two, two),
        "the rotation of group 1 is by 5.7.*e.301, of which rounding": lambda: rigid(
            points, group, [[0, 0, 1e9], [1e300, 0, 0]], two
        ),
        "the rotation of group 0 is by inf": lambda: rigid(
            points, group, jnp.full((2, 3), 1e308), two
        ),
        "the moved points overflow": lambda: rigid(points, group, two, two + 1e308, two + 1e308),
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
