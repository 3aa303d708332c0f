"""Weights of skinning, against closed forms and bounded least squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp
from helpers import EXACT, FD, bumpy_sheet

import jaxdeform as jd


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


def strip_of_slivers(degrees):
    """Return a band of 38 triangles with two angles like that."""
    x = np.arange(20.0)
    low = np.stack([x, 0 * x, 0 * x], axis=1)
    high = low + np.array([0.5, np.tan(np.radians(degrees)), 0])
    k = np.arange(19)
    faces = [np.stack([k, k + 1, k + 20], 1), np.stack([k + 1, k + 21, k + 20], 1)]
    return jd.Mesh(np.concatenate([low, high]), np.concatenate(faces))


def test_biharmonic_weights_on_slivers_are_refused_with_the_reason():
    """libigl raises a RuntimeError there, and its text names no reason."""
    weights = jd.bounded_biharmonic_weights(strip_of_slivers(1e-5), [0, 19])
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=EXACT)
    with pytest.raises(jd.InputError, match=r"some triangles are too thin: see jd\.inspect"):
        jd.bounded_biharmonic_weights(strip_of_slivers(1e-7), [0, 19])
