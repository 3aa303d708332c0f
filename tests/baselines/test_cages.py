"""Mean value coordinates, by quadrature."""

import numpy as np
import pytest
from helpers import CUBE, EXACT
from scipy.spatial.transform import Rotation

import jaxdeform as jd


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
