"""Skinning: against loops, invariants, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import BLENDS, EXACT, FD, motions, random_skin
from scipy.spatial.transform import Rotation

import jaxdeform as jd


@pytest.mark.parametrize("blend", BLENDS)
def test_equal_motions_are_that_motion(blend):
    vertices, weights, moves = random_skin()
    same = np.broadcast_to(moves[:1], moves.shape)
    want = vertices @ moves[0, :, :3].T + moves[0, :, 3]
    np.testing.assert_allclose(blend(vertices, weights, same), want, atol=EXACT)
    one = np.ones((len(vertices), 1))
    np.testing.assert_allclose(blend(vertices, one, moves[:1]), want, atol=EXACT)


@pytest.mark.parametrize("blend", BLENDS)
def test_translations_are_blended_linearly(blend):
    vertices, weights, _ = random_skin()
    shifts = np.random.default_rng(1).normal(size=(4, 3))
    out = blend(vertices, weights, motions(np.zeros((4, 3)), shifts))
    np.testing.assert_allclose(out, vertices + weights @ shifts, atol=EXACT)


@pytest.mark.parametrize("blend", BLENDS)
def test_another_frame_gives_the_same_shape(blend):
    """Moving mesh and motions by one rigid G moves the result by G."""
    vertices, weights, moves = random_skin()
    to = np.eye(4)
    to[:3] = motions([[0.3, -1.1, 2.0]], [[3.0, -4.0, 5.0]])[0]
    full = np.tile(np.eye(4), (4, 1, 1))
    full[:, :3] = moves
    other = (to @ full @ np.linalg.inv(to))[:, :3]
    want = np.asarray(blend(vertices, weights, moves)) @ to[:3, :3].T + to[:3, 3]
    got = blend(vertices @ to[:3, :3].T + to[:3, 3], weights, other)
    np.testing.assert_allclose(got, want, atol=EXACT)


def test_linear_blending_is_its_formula():
    vertices, weights, _ = random_skin()
    moves = np.random.default_rng(2).normal(size=(4, 3, 4))  # any affine ones
    want = np.zeros_like(vertices)
    for i, p in enumerate(vertices):
        for j, t in enumerate(moves):
            want[i] += weights[i, j] * (t[:, :3] @ p + t[:, 3])
    np.testing.assert_allclose(jd.linear_blend_skinning(vertices, weights, moves), want, atol=EXACT)


def hamilton(p, q):
    w = p[0] * q[0] - p[1:] @ q[1:]
    return np.r_[w, p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])]


def blended_by_loops(vertices, weights, moves):
    """Kavan et al. 2008 vertex by vertex, on SciPy's quaternions."""
    pairs = []
    for move in moves:
        x, y, z, w = Rotation.from_matrix(move[:, :3]).as_quat()
        real = np.array([w, x, y, z])
        pairs.append((real, 0.5 * hamilton(np.r_[0.0, move[:, 3]], real)))
    out = []
    for p, row in zip(vertices, weights, strict=True):
        pivot = pairs[int(np.argmax(row))][0]
        signs = [np.sign(real @ pivot) for real, _ in pairs]
        real = sum(w * s * q for w, s, (q, _) in zip(row, signs, pairs, strict=True))
        dual = sum(w * s * q for w, s, (_, q) in zip(row, signs, pairs, strict=True))
        length = np.linalg.norm(real)
        real, dual = real / length, dual / length
        shift = 2 * hamilton(dual, real * [1, -1, -1, -1])[1:]
        out.append(Rotation.from_quat(np.r_[real[1:], real[0]]).apply(p) + shift)
    return np.array(out)


@pytest.mark.parametrize("spread", [0.0, 1e-9, 0.5, 3.0])
def test_dual_quaternions_by_loops(spread):
    vertices, weights, moves = random_skin(spread=spread, seed=3)
    got = jd.dual_quaternion_skinning(vertices, weights, moves)
    np.testing.assert_allclose(got, blended_by_loops(vertices, weights, moves), atol=EXACT)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -2, 3]])
def test_half_turns_about_any_axis(axis):
    """180 degrees is where quaternions by the trace formula divide by zero."""
    axis = np.pi * np.array(axis) / np.linalg.norm(axis)
    move = motions([axis], [[1.0, 2.0, 3.0]])
    vertices = np.random.default_rng(4).normal(size=(5, 3))
    got = jd.dual_quaternion_skinning(vertices, np.ones((5, 1)), move)
    np.testing.assert_allclose(got, vertices @ move[0, :, :3].T + move[0, :, 3], atol=EXACT)


def test_halfway_to_a_screw_motion_is_half_the_screw():
    """Turn about an axis through a point and glide along it: half weight, half of both."""
    axis, point = np.array([1.0, 2.0, -2.0]) / 3, np.array([0.5, -1.0, 2.0])

    def screw(angle, glide):
        turn = Rotation.from_rotvec(angle * axis).as_matrix()
        return np.concatenate([turn, (point - turn @ point + glide * axis)[:, None]], axis=1)

    vertices = np.random.default_rng(5).normal(size=(7, 3))
    moves = np.stack([screw(0.0, 0.0), screw(2.4, 0.7)])
    got = jd.dual_quaternion_skinning(vertices, np.full((7, 2), 0.5), moves)
    half = screw(1.2, 0.35)
    np.testing.assert_allclose(got, vertices @ half[:, :3].T + half[:, 3], atol=EXACT)


def test_the_shorter_way_round():
    """Between +100 and -100 degrees lies 180, not 0; a full turn is none."""
    moves = motions([[0, 0, np.radians(100)], [0, 0, np.radians(-100)]], np.zeros((2, 3)))
    got = jd.dual_quaternion_skinning([[1.0, 0.0, 0.0]], [[0.5, 0.5]], moves)
    np.testing.assert_allclose(got, [[-1.0, 0.0, 0.0]], atol=EXACT)
    moves = motions([[0, 0, 0.1], [0, 0, 2 * np.pi + 0.3]], np.zeros((2, 3)))
    got = jd.dual_quaternion_skinning([[1.0, 0.0, 0.0]], [[0.5, 0.5]], moves)
    np.testing.assert_allclose(got, [[np.cos(0.2), np.sin(0.2), 0.0]], atol=EXACT)


@pytest.mark.parametrize("degrees", [90.0, 150.0, 180.0])
def test_a_twist_collapses_matrices_but_not_dual_quaternions(bar, degrees):
    """The distance to the axis is scaled by |w + (1 - w) e^(i angle)|, against kept."""
    axis = np.array([0.0, 0.0])
    radius = np.hypot(*(bar.vertices[:, [0, 2]] - axis).T)
    upper = bar.vertices[:, 1] / bar.vertices[:, 1].max()
    weights = np.stack([1 - upper, upper], axis=1)
    angle = np.radians(degrees)
    moves = motions([[0, 0, 0], [0, angle, 0]], np.zeros((2, 3)))
    linear = np.asarray(jd.linear_blend_skinning(bar.vertices, weights, moves))
    dual = np.asarray(jd.dual_quaternion_skinning(bar.vertices, weights, moves))
    shrunk = radius * np.abs(weights[:, 0] + weights[:, 1] * np.exp(1j * angle))
    np.testing.assert_allclose(np.hypot(linear[:, 0], linear[:, 2]), shrunk, atol=1e-9)
    np.testing.assert_allclose(np.hypot(dual[:, 0], dual[:, 2]), radius, atol=1e-9)
    if degrees == 180.0:
        middle = np.abs(upper - 0.5) < 0.02
        assert (shrunk[middle] < 0.1 * radius[middle].max()).all()


@pytest.mark.parametrize("blend", BLENDS)
def test_jit_and_vmap_over_poses(blend):
    vertices, weights, moves = random_skin()
    poses = np.stack([moves, moves[::-1]])
    batch = jax.jit(jax.vmap(lambda t: blend(vertices, weights, t)))(poses)
    for got, pose in zip(batch, poses, strict=True):
        np.testing.assert_allclose(got, blend(vertices, weights, pose), atol=EXACT)


CHAINS = {
    "the identity": np.zeros((3, 3)),
    "180 degrees in steps": np.array([[0, 0, 0], [0, np.pi / 2, 0], [0, np.pi, 0]]),
    "three half turns": np.array([[0, np.pi, 0]] * 3),
    "any": np.array([[0.3, 0.1, -0.5], [1.0, -0.2, 0.4], [0.2, 1.5, 0.1]]),
}


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("name", CHAINS)
def test_derivatives_of_blending_by_differences(blend, name):
    rng = np.random.default_rng(6)
    vertices = rng.normal(size=(6, 3))
    # Neighbouring controls only, as along a chain: between 0 and 180 degrees there is a jump.
    upper = np.linspace(0.1, 0.9, 3)
    weights = np.zeros((6, 3))
    weights[:3, :2] = np.stack([1 - upper, upper], axis=1)
    weights[3:, 1:] = np.stack([1 - upper, upper], axis=1)
    goal = rng.normal(size=(6, 3))
    where = (CHAINS[name], rng.normal(size=(3, 3)), vertices, weights)
    move = [rng.normal(size=x.shape) for x in where]
    move[3] *= weights > 0

    @jax.jit
    def loss(turn, shift, vertices, weights):
        moves = jd.rigid_transforms(turn, shift, jnp.zeros_like(shift))
        return jnp.sum(goal * blend(vertices, weights, moves))

    h = 1e-5
    step = [[x + s * h * d for x, d in zip(where, move, strict=True)] for s in (1, -1)]
    want = (loss(*step[0]) - loss(*step[1])) / (2 * h)
    gradient = jax.grad(loss, (0, 1, 2, 3))(*map(jnp.asarray, where))
    got = sum(float(jnp.sum(g * d)) for g, d in zip(gradient, move, strict=True))
    np.testing.assert_allclose(got, want, rtol=FD)
    _, forward = jax.jvp(loss, tuple(map(jnp.asarray, where)), tuple(map(jnp.asarray, move)))
    np.testing.assert_allclose(forward, got, rtol=1e-9)


def test_derivatives_to_the_twelve_numbers_of_a_transform():
    vertices, weights, moves = random_skin(spread=0.3)
    goal = np.random.default_rng(7).normal(size=vertices.shape)
    for blend in BLENDS:
        loss = jax.jit(lambda t, blend=blend: jnp.sum(goal * blend(vertices, weights, t)))
        gradient = jax.grad(loss)(jnp.asarray(moves))
        for at in np.ndindex(2, 3, 4):
            d = np.zeros_like(moves)
            d[at] = 1e-6
            want = (loss(moves + d) - loss(moves - d)) / 2e-6
            np.testing.assert_allclose(gradient[at], want, rtol=FD, atol=1e-7)


def test_motions_that_no_number_holds_are_named():
    zero = np.zeros((1, 3))
    with pytest.raises(jd.InputError, match="rotations turn by inf, of which rounding leaves no"):
        jd.rigid_transforms([[1e200, 0.0, 0.0]], zero, zero)
    with pytest.raises(jd.InputError, match="overflow"):
        jd.rigid_transforms(zero, [[1.7e308, 0.0, 0.0]], [[1.7e308, 0.0, 0.0]])


def test_shape_errors_also_come_while_tracing():
    vertices, weights, moves = random_skin()
    with pytest.raises(jd.InputError, match="transforms have shape"):
        jax.jit(lambda t: jd.linear_blend_skinning(vertices, weights, t))(moves[1:])
