"""Skinning: closed forms, SciPy's rotations, quadrature, and what the weights promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp
from conftest import EXACT, FD
from scipy.spatial.transform import Rotation
from sheet import bumpy_sheet

import jaxdeform as jd

CUBE = jd.Mesh(
    [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)],
    # Two triangles a side, seen from outside.
    [
        *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
        *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
    ],
)


def motions(rotations, shifts):
    """(m, 3, 4) by SciPy."""
    turn = Rotation.from_rotvec(np.asarray(rotations, float)).as_matrix()
    return np.concatenate([turn, np.asarray(shifts, float)[:, :, None]], axis=2)


def random_skin(n=40, m=4, seed=0, spread=0.8):
    rng = np.random.default_rng(seed)
    weights = rng.uniform(size=(n, m)) ** 3
    weights /= weights.sum(axis=1, keepdims=True)
    moves = motions(spread * rng.normal(size=(m, 3)), rng.normal(size=(m, 3)))
    return rng.normal(size=(n, 3)), weights, moves


# ---------------------------------------------------------------- blending

BLENDS = [jd.linear_blend_skinning, jd.dual_quaternion_skinning]


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


# ---------------------------------------------------------------- transformations of JAX


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


# ---------------------------------------------------------------- weights by distance


def test_two_points_by_hand():
    """Distances 1 and 3: 1/1 to 1/9 for power 2, 1/1 to 1/3 for power 1."""
    vertices, controls = [[0.0, 1.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
    two = jd.inverse_distance_weights(vertices, controls)
    np.testing.assert_allclose(two, [[0.9, 0.1]], atol=EXACT)
    one = jd.inverse_distance_weights(vertices, controls, power=1.0)
    np.testing.assert_allclose(one, [[0.75, 0.25]], atol=EXACT)
    np.testing.assert_array_equal(jd.rigid_weights(vertices, controls), [[1.0, 0.0]])


def test_on_a_control():
    controls = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [0, 5.0, 0]])
    weights = jd.inverse_distance_weights(controls, controls, power=7.0)
    np.testing.assert_array_equal(
        weights, [[1, 0, 0, 0], [0, 0.5, 0.5, 0], [0, 0.5, 0.5, 0], [0, 0, 0, 1]]
    )
    # Rigid weights sum to one there too, where the thesis's formula would give two ones.
    np.testing.assert_array_equal(np.sum(jd.rigid_weights(controls, controls), axis=1), np.ones(4))
    slope = jax.grad(lambda c: jd.inverse_distance_weights(controls, c)[0, 0])(controls)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e100])
def test_no_scale_overflows(scale):
    rng = np.random.default_rng(8)
    vertices, controls = rng.normal(size=(9, 3)), rng.normal(size=(3, 3))
    want = np.linalg.norm(vertices[:, None] - controls, axis=2) ** -6.0
    got = jd.inverse_distance_weights(scale * vertices, scale * controls, power=6.0)
    np.testing.assert_allclose(got, want / want.sum(axis=1, keepdims=True), atol=1e-9)


def test_a_bone_is_as_near_as_its_nearest_point():
    rng = np.random.default_rng(9)
    vertices, bones = 2 * rng.normal(size=(30, 3)), rng.normal(size=(4, 2, 3))
    s = np.linspace(0, 1, 20_001)[:, None]
    samples = [a + s * (b - a) for a, b in bones]
    distance = np.stack(
        [np.linalg.norm(vertices[:, None] - line, axis=2).min(axis=1) for line in samples], axis=1
    )
    want = distance**-2.0
    got = jd.inverse_distance_weights(vertices, bones)
    # The samples are 1e-4 apart, so their distances are right to about 1e-8.
    np.testing.assert_allclose(got, want / want.sum(axis=1, keepdims=True), atol=1e-6)
    np.testing.assert_array_equal(
        np.argmax(jd.rigid_weights(vertices, bones), axis=1), distance.argmin(axis=1)
    )


def test_derivatives_of_weights_by_differences():
    rng = np.random.default_rng(10)
    vertices, goal = rng.normal(size=(12, 3)), rng.normal(size=(12, 4))
    for controls in (rng.normal(size=(4, 3)), rng.normal(size=(4, 2, 3))):
        loss = jax.jit(
            lambda c, power: jnp.sum(goal * jd.inverse_distance_weights(vertices, c, power))
        )
        d, h = rng.normal(size=controls.shape), 1e-6
        want = (loss(controls + h * d, 2.0 + h) - loss(controls - h * d, 2.0 - h)) / (2 * h)
        slope, power = jax.grad(loss, (0, 1))(jnp.asarray(controls), 2.0)
        np.testing.assert_allclose(jnp.sum(slope * d) + power, want, rtol=FD)


def horseshoe(bar):
    """The bar bent to a C: its ends are near in space and far along the surface."""
    angle = np.radians(310.0) * bar.vertices[:, 1] / 151.0
    radius = 28.0 - bar.vertices[:, 0]
    out = np.stack([radius * np.cos(angle), radius * np.sin(angle), bar.vertices[:, 2]], axis=1)
    return jd.Mesh(out, bar.faces)


def test_properties_of_the_four_kinds_of_weights(bar):
    """Thesis chapter 3: non-negative, partition of unity, local, shape-aware."""
    mesh = horseshoe(bar)
    y = bar.vertices[:, 1]
    # Whole cross-sections for biharmonic weights, their inner middles for distances.
    sections = [np.flatnonzero(np.abs(y - at) < 3) for at in (0.0, 75.5, 151.0)]
    group = np.repeat(np.arange(3), [len(s) for s in sections])
    controls = np.array(
        [s[np.argmax(bar.vertices[s, 0] - np.abs(bar.vertices[s, 2]))] for s in sections]
    )
    points = mesh.vertices[controls]
    along = jd.geodesic_distances(mesh, controls)
    kinds = {
        "rigid": jd.rigid_weights(mesh.vertices, points),
        "inverse": jd.inverse_distance_weights(mesh.vertices, points),
        "geodesic": jd.inverse_distance_weights(mesh.vertices, points, distances=along),
        "biharmonic": jd.bounded_biharmonic_weights(mesh, np.concatenate(sections), group),
    }
    for weights in map(np.asarray, kinds.values()):
        assert weights.shape == (722, 3)
        assert weights.min() >= 0
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=EXACT)
        np.testing.assert_allclose(weights[controls], np.eye(3), atol=EXACT)
    # Local: rigid and biharmonic weights are 0 over a part of the shape, the others nowhere.
    beyond = (y > 80) & (y < 145)
    for kind, weight in kinds.items():
        near = np.asarray(weight)[beyond, 0].max()
        assert near < 0.05 if kind in ("rigid", "biharmonic") else near > 0.01, kind
    # Shape-aware: the far end is near to control 0 in space and to control 1 along the shape.
    end, two = np.flatnonzero(y > 148), {"distances": along[:, :2]}
    for weights in (jd.rigid_weights, jd.inverse_distance_weights):
        assert (np.asarray(weights(mesh.vertices, points[:2]))[end, 0] > 0.5).all()
        assert (np.asarray(weights(mesh.vertices, points[:2], **two))[end, 0] < 0.5).all()
    assert np.asarray(kinds["biharmonic"])[y > 80, 0].max() < 1e-6


def test_geodesic_distances():
    """On a flat sheet they are straight; around a box they follow its unfolding."""
    square = jd.shapes.square()
    flat = jd.geodesic_distances(square, [0, 4])
    straight = np.linalg.norm(square.vertices[:, None] - square.vertices[[0, 4]], axis=2)
    np.testing.assert_allclose(flat, straight, atol=1e-7)
    around = jd.geodesic_distances(CUBE, [0])[7, 0]
    np.testing.assert_allclose(around, np.sqrt(2.0**2 + 4.0**2), rtol=1e-7)
    two = jd.Mesh(
        np.concatenate([square.vertices, square.vertices + 9, [[5, 5, 5]]]),
        np.concatenate([square.faces, square.faces + 9]),
    )
    apart = jd.geodesic_distances(two, [4, 18])
    np.testing.assert_allclose(apart[:9, 0], flat[:, 1], atol=1e-7)
    assert np.isinf(apart[9:, 0]).all()
    assert apart[18, 1] == 0


def test_biharmonic_weights_by_bounded_least_squares():
    """|M^-1/2 L w|^2 with bounds, by SciPy's active set method on a dense matrix."""
    mesh = bumpy_sheet()
    handles, group = np.array([0, 1, 55, 30]), np.array([0, 0, 1, 2])
    w, (i, j) = jd.cotangent_weights(mesh), mesh.edges.T
    laplacian = sp.csgraph.laplacian(
        sp.coo_matrix((np.r_[w, w], (np.r_[i, j], np.r_[j, i])), shape=(56, 56)).tocsr()
    ).toarray()
    root = laplacian / np.sqrt(mixed_areas(mesh))[:, None]
    free = np.setdiff1d(np.arange(56), handles)
    want = np.zeros((56, 3))
    want[handles, group] = 1.0
    for k in range(3):
        right = -root[:, handles] @ want[handles, k]
        found = scipy.optimize.lsq_linear(root[:, free], right, (0, 1), method="bvls", tol=1e-14)
        want[free, k] = found.x
    assert (want[free] == 0).any()  # the bounds are at work
    want /= want.sum(axis=1, keepdims=True)
    got = jd.bounded_biharmonic_weights(mesh, handles, group)
    np.testing.assert_allclose(got, want, atol=1e-6)


def mixed_areas(mesh):
    """Voronoi areas, mixed as by Meyer et al. 2003 (what libigl's default mass matrix is)."""
    area = np.zeros(mesh.n_vertices)
    for face in mesh.faces:
        p = mesh.vertices[face]
        whole = 0.5 * np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0]))
        edge = [p[(k + 2) % 3] - p[(k + 1) % 3] for k in range(3)]
        cot = [-edge[(k + 1) % 3] @ edge[(k + 2) % 3] / (2 * whole) for k in range(3)]
        for k in range(3):
            if min(cot) < 0:
                area[face[k]] += whole / (2 if cot[k] < 0 else 4)
            else:
                sides = [((k + 1) % 3), ((k + 2) % 3)]
                area[face[k]] += sum(edge[s] @ edge[s] * cot[s] for s in sides) / 8
    return area


# ---------------------------------------------------------------- cages


def by_quadrature(x, cage):
    """Ju et al.'s definition: the mean of f / distance over all directions, f linear on faces.

    A piece dA of a face fills the solid angle cos dA / distance^2.
    """
    node, weight = np.polynomial.legendre.leggauss(40)
    node, weight = (node + 1) / 2, weight / 2
    s, t = (a.ravel() for a in np.meshgrid(node, node))
    # Duffy's map of the unit square to the triangle.
    share = np.stack([1 - s, s * (1 - t), s * t], axis=1)
    jacobian = s * np.outer(weight, weight).ravel()
    out = np.zeros(cage.n_vertices)
    for face in cage.faces:
        p = cage.vertices[face]
        normal = np.cross(p[1] - p[0], p[2] - p[0])
        arm = share @ p - x
        density = jacobian * (arm @ normal) / np.linalg.norm(arm, axis=1) ** 4
        np.add.at(out, face, density @ share)
    return out / out.sum()


def test_mean_values_by_quadrature():
    points = np.array([[0.1, 0.2, -0.3], [0.0, 0.0, 0.0], [0.6, -0.5, 0.55]])
    got = jd.mean_value_coordinates(points, CUBE)
    for row, x in zip(got, points, strict=True):
        np.testing.assert_allclose(row, by_quadrature(x, CUBE), atol=1e-8)


def l_shape():
    """A cage that is not convex: two boxes side by side, one of them higher."""
    steps = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)
    vertices = [[x, y, z] for z in (0.0, 1.0) for x, y in steps]
    wall = [(k, (k + 1) % 6, (k + 1) % 6 + 6, k + 6) for k in range(6)]
    faces = [f for a, b, c, d in wall for f in ((a, b, c), (a, c, d))]
    lid = [(0, 1, 3), (1, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces += [(a, c, b) for a, b, c in lid] + [(a + 6, b + 6, c + 6) for a, b, c in lid]
    return jd.Mesh(vertices, faces)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("cage", [CUBE, l_shape()], ids=["cube", "L"])
def test_mean_values_reproduce_linear_functions(cage, turned):
    rng = np.random.default_rng(11)
    low, high = cage.vertices.min(axis=0), cage.vertices.max(axis=0)
    points = rng.uniform(low, high, (200, 3))
    if len(cage.vertices) == 12:
        points = points[(points[:, 0] < 1) | (points[:, 1] < 1)]
        assert len(points) > 100
    mesh = jd.Mesh(cage.vertices, cage.faces[:, ::-1]) if turned else cage
    weights = np.asarray(jd.mean_value_coordinates(points, mesh))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=EXACT)
    np.testing.assert_allclose(weights @ cage.vertices, points, atol=1e-9)
    assert (weights.min() >= 0) == (len(cage.vertices) == 8)  # in a convex cage only
    shear = rng.normal(size=(3, 3))
    np.testing.assert_allclose(weights @ (cage.vertices @ shear), points @ shear, atol=1e-8)


def test_mean_values_on_the_cage():
    """Corners, sides, faces and the planes of faces: closed forms, reached continuously."""
    cage = l_shape()
    np.testing.assert_allclose(
        jd.mean_value_coordinates(cage.vertices, cage), np.eye(12), atol=EXACT
    )
    rng = np.random.default_rng(12)
    for face in cage.faces:
        share = rng.dirichlet(np.ones(3))
        want = np.zeros(12)
        want[face] = share
        on = share @ cage.vertices[face]
        np.testing.assert_allclose(jd.mean_value_coordinates(on[None], cage)[0], want, atol=1e-9)
        side = 0.3 * cage.vertices[face[0]] + 0.7 * cage.vertices[face[1]]
        want = np.zeros(12)
        want[face[:2]] = 0.3, 0.7
        np.testing.assert_allclose(jd.mean_value_coordinates(side[None], cage)[0], want, atol=1e-9)
        a, b, c = cage.vertices[face]
        normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        near = jd.mean_value_coordinates((on - 1e-6 * normal)[None], cage)[0]
        np.testing.assert_allclose(near @ cage.vertices, on - 1e-6 * normal, atol=1e-9)
        assert np.abs(near - jd.mean_value_coordinates(on[None], cage)[0]).max() < 1e-4
    # In the planes x = 1 and y = 1 of the notch's walls.
    for tilt in (0.0, 1e-12, 1e-8, 1e-5):
        point = np.array([[1.0 - tilt, 0.4, 0.3], [0.4, 1.0 - tilt, 0.6]])
        weights = jd.mean_value_coordinates(point, cage)
        # Near such a plane two nearly equal directions are subtracted: half the digits go.
        np.testing.assert_allclose(weights @ cage.vertices, point, atol=1e-7)


def test_a_bar_in_its_cage(bar):
    """Twelve corners around the bar: bending them bends it, and moves of the cage carry over."""
    box = np.array(
        [[x, y, z] for y in (-5.0, 75.0, 156.0) for x in (-20.0, 20.0) for z in (-20.0, 20.0)]
    )
    ring = [(0, 2, 3, 1), (4, 6, 7, 5), (8, 10, 11, 9)]
    faces = [(0, 2, 3), (0, 3, 1), (8, 9, 11), (8, 11, 10)]
    for low, high in ((ring[0], ring[1]), (ring[1], ring[2])):
        for k in range(4):
            a, b = low[k], low[(k + 1) % 4]
            c, d = high[k], high[(k + 1) % 4]
            faces += [(a, d, b), (a, c, d)]
    cage = jd.Mesh(box, faces)
    weights = jd.mean_value_coordinates(bar.vertices, cage)
    turn = Rotation.from_rotvec([0.1, 1.0, -0.4]).as_matrix()
    np.testing.assert_allclose(weights @ (box @ turn.T + 3), bar.vertices @ turn.T + 3, atol=1e-8)


# ---------------------------------------------------------------- skeletons


def test_reading_a_skeleton(tmp_path):
    path = tmp_path / "hand.tgf"
    path.write_text(
        "1 0 0 0\n2 0 1 0\n\n3 0 2.5 1e-1\n4 9 9 9\n"
        "#\n1 2 1 0 0\n2 3\n3 4 0 0 1\n4 1 0 1 0\n#\n1 2 3\n"
    )
    skeleton = jd.load_skeleton(path)
    np.testing.assert_array_equal(skeleton.bones, [[0, 1], [1, 2]])  # no cage edge, no pseudo edge
    np.testing.assert_array_equal(skeleton.segments[1], [[0, 1, 0], [0, 2.5, 0.1]])
    assert "4 joints, 2 bones" in repr(skeleton)
    assert jd.inverse_distance_weights(np.ones((5, 3)), skeleton.segments).shape == (5, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no bones"),
        ("1 0 0 0\n2 1 1 1\n1 2\n", "line 3: expected joint 3"),
        ("1 0 0 0\n2 1 1 1\n#\n", "no bones"),
        ("1 0 0\n#\n", "line 1: expected joint 1"),
        ("1 0 0 nan\n#\n", "line 1: expected joint 1"),
        ("1 0 0 zero\n#\n", "line 1: '1 0 0 zero' is no joint"),
        ("0 0 0 0\n#\n", "line 1: expected joint 1"),
        ("1 0 0 0\n2 1 1 1\n#\n1 3\n", "line 4: edge 1 3 names a joint out of range"),
        ("1 0 0 0\n2 1 1 1\n#\n0 1\n", "line 4: edge 0 1 names a joint out of range"),
        ("1 0 0 0\n2 1 1 1\n#\n1\n", "line 4: '1' is no edge"),
        ("1 0 0 0\n2 1 1 1\n#\n1 a\n", "line 4: '1 a' is no edge"),
        ("1 0 0 0\n2 0 0 0\n#\n1 2\n", "line 4: the bone from 1 to 2 has length zero"),
    ],
)
def test_broken_skeletons(tmp_path, text, message):
    path = tmp_path / "broken.tgf"
    path.write_text(text)
    with pytest.raises(jd.InputError, match=message) as caught:
        jd.load_skeleton(path)
    assert "broken.tgf" in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- bad input


def bad_calls():
    vertices, weights, moves = random_skin()
    stretched = moves.copy()
    stretched[2, :, :3] *= 1.01
    mirrored = moves.copy()
    mirrored[1, :, :3] *= -1
    heavy = weights.copy()
    heavy[7] *= 1.1
    negative = weights.copy()
    negative[3] = [1.5, -0.5, 0, 0]
    nan = vertices.copy()
    nan[4, 1] = np.nan
    bones = np.ones((2, 2, 3))
    bones[0, 1] = 0
    fan = jd.Mesh(np.eye(5, 3) + 0.1, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    square = jd.shapes.square()
    # Two sheets that share one corner.
    aside = square.vertices + np.array([2.0, 2.0, 0.0])
    touching = jd.Mesh(
        np.concatenate([square.vertices, aside[1:]]),
        np.concatenate([square.faces, square.faces + 8]),
    )
    loose = jd.Mesh(np.concatenate([square.vertices, [[9, 9, 9]]]), square.faces)
    two = jd.Mesh(
        np.concatenate([square.vertices, square.vertices + 9]),
        np.concatenate([square.faces, square.faces + 9]),
    )
    far = np.full((40, 3), np.inf)
    lbs, dqs = BLENDS
    idw, bbw, mvc = (
        jd.inverse_distance_weights,
        jd.bounded_biharmonic_weights,
        jd.mean_value_coordinates,
    )
    return {
        "weights of vertex 7 sum to 1.1": lambda: lbs(vertices, heavy, moves),
        r"weights have shape \(39, 4\)": lambda: lbs(vertices, weights[1:], moves),
        "transforms have shape": lambda: lbs(vertices, weights, moves[:3]),
        "transforms cannot be read": lambda: lbs(vertices, weights, "north"),
        "vertices of vertex 4 are not finite": lambda: dqs(nan, weights, moves),
        "vertices have shape": lambda: dqs(vertices[:, :2], weights, moves),
        "a weight of vertex 3 is -0.5": lambda: dqs(vertices, negative, moves),
        "the matrix of control 2 is no rotation": lambda: dqs(vertices, weights, stretched),
        "the matrix of control 1 is no rotation": lambda: dqs(vertices, weights, mirrored),
        "rotations have shape": lambda: jd.rigid_transforms([0, 0, 1], [0, 0, 0], [0, 0, 0]),
        "centers have shape": lambda: jd.rigid_transforms([[0, 0, 1]], [[0, 0, 0]], [0, 0, 0]),
        "bone 1 has length zero": lambda: idw(vertices, bones),
        "controls have shape": lambda: idw(vertices, bones[:, :, :2]),
        "controls of control 0 are not finite": lambda: idw(vertices, [[0, 0, np.inf]]),
        "power is 0": lambda: idw(vertices, [[0, 0, 0]], 0.0),
        "distances have shape": lambda: idw(vertices, np.eye(3), distances=np.ones((40, 2))),
        "vertex 0 is connected to no control": lambda: idw(vertices, np.eye(3), distances=far),
        "distance of vertex 0 to control 0 is -inf": lambda: jd.rigid_weights(
            vertices, np.eye(3), distances=-far
        ),
        "handle 9 .*out of range": lambda: jd.geodesic_distances(square, [9]),
        "need a manifold surface": lambda: jd.geodesic_distances(fan, [0]),
        "distances need a manifold": lambda: jd.geodesic_distances(touching, [0]),
        "handle 99 .*out of range": lambda: bbw(square, [99]),
        "group 1 has no handles": lambda: bbw(square, [0, 8], [0, 2]),
        "the group of handle 1 is -1": lambda: bbw(square, [0, 8], [0, -1]),
        "group has shape": lambda: bbw(square, [0, 8], [0]),
        "vertex 9 belongs to no face": lambda: bbw(loose, [0]),
        "part with vertex 9 .*no handle": lambda: bbw(two, [0]),
        "the cage is open, .*edge": lambda: mvc(square.vertices, square),
        "turned against each other, at the edge": lambda: mvc(
            [[0, 0, 0]], jd.Mesh(CUBE.vertices, [CUBE.faces[0][::-1], *CUBE.faces[1:]])
        ),
        r"vertex 1 \[0.0, 1.5, 0.0\] is outside": lambda: mvc([[0, 0, 0], [0, 1.5, 0]], CUBE),
        "vertices have shape .*finite": lambda: mvc([[0, 0, np.nan]], CUBE),
        "skeletons are .tgf files": lambda: jd.load_skeleton("bones.txt"),
        "cannot be read": lambda: jd.load_skeleton("nowhere.tgf"),
    }


@pytest.mark.parametrize("message", bad_calls())
def test_bad_input_gets_a_clear_error(message):
    with pytest.raises(jd.InputError, match=message) as caught:
        bad_calls()[message]()
    assert "\n" not in str(caught.value)


def test_shape_errors_also_come_while_tracing():
    vertices, weights, moves = random_skin()
    with pytest.raises(jd.InputError, match="transforms have shape"):
        jax.jit(lambda t: jd.linear_blend_skinning(vertices, weights, t))(moves[1:])
