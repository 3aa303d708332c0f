"""Generated meshes against what makes a good mesh, motions against scipy's rotations."""

from functools import partial

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, ends
from scipy.spatial.transform import Rotation

import jaxdeform as jd

CLOSED = {
    "bar": jd.shapes.bar,
    "cylinder": jd.shapes.cylinder,
    "cactus": jd.shapes.cactus,
    # The default, 50,298 vertices, takes 12 s.
    "octopus": partial(jd.shapes.octopus, 6000),
}


@pytest.fixture(params=CLOSED, scope="module")
def closed(request):
    return request.param, CLOSED[request.param]()


def test_sizes(closed):
    name, mesh = closed
    if name == "bar":
        assert (mesh.n_vertices, mesh.n_faces) == (722, 1440)
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [30, 151, 30], rtol=EXACT)
        assert mesh.vertices[:, 1].min() == 0
    elif name == "cylinder":
        assert (mesh.n_vertices, mesh.n_faces) == (4802, 9600)
        assert np.bincount(mesh.edges.ravel()).max() == 40
    elif name == "cactus":
        assert abs(mesh.n_vertices / 5300 - 1) < 0.05
    else:
        assert abs(mesh.n_vertices / 6000 - 1) < 0.05


def test_closed_manifold_and_outward(closed):
    _, mesh = closed
    v, f = mesh.vertices, np.asarray(mesh.faces)
    directed = {(int(face[i]), int(face[(i + 1) % 3])) for face in f for i in range(3)}
    # Every directed edge once, and its reverse too: closed, manifold edges, oriented alike.
    assert len(directed) == 3 * len(f)
    assert directed == {(j, i) for i, j in directed}
    assert igl.is_vertex_manifold(f).all()
    assert len(np.unique(f)) == len(v)
    components = igl.connected_components(igl.adjacency_matrix(f))
    assert components[0] == 1
    assert len(v) - len(mesh.edges) + len(f) == 2
    box = np.prod(np.ptp(v, axis=0))
    assert 0.02 * box < volume(mesh) <= box * (1 + EXACT)


def test_no_slivers(closed):
    """A cap of 40 narrow triangles at each pole of the cylinder, 9 degrees, is part of it."""
    name, mesh = closed
    angles = np.degrees(igl.internal_angles(mesh.vertices, np.asarray(mesh.faces)))
    assert angles.min() > {"bar": 40, "cylinder": 8}.get(name, 15)
    assert angles.max() < 150


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def test_volumes_are_those_of_the_solids():
    np.testing.assert_allclose(volume(jd.shapes.bar()), 30 * 151 * 30, rtol=EXACT)
    prism = 40 / 2 * np.sin(2 * np.pi / 40) * 12  # a 40-gon of radius 1, 12 high
    np.testing.assert_allclose(volume(jd.shapes.cylinder()), prism, rtol=EXACT)


def test_square_is_fig_4_1():
    mesh = jd.shapes.square()
    assert sorted(map(tuple, mesh.vertices)) == [
        (x, y, 0.0) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)
    ]
    assert mesh.vertices[4].tolist() == [0, 0, 0]
    corner = mesh.vertices[mesh.faces]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(normals, np.broadcast_to([0, 0, 1.0], (8, 3)), atol=EXACT)


@pytest.mark.parametrize("count", [4999, 0, -1, 5000.5, "6000", True])
def test_octopus_of_a_bad_size(count):
    with pytest.raises(jd.InputError, match="octopus"):
        jd.shapes.octopus(count)


# ---------------------------------------------------------------- motions

POINTS = np.random.default_rng(0).normal(size=(12, 3))
CENTER = np.array([0.3, -2.0, 1.0])


@pytest.mark.parametrize(
    ("axis", "vector"), [("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1]), ([1, -2, 0.5],) * 2]
)
@pytest.mark.parametrize("degrees", [0.0, 37.0, -180.0, 720.0])
def test_rotate_is_scipys(axis, vector, degrees):
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array(vector) / np.linalg.norm(vector))
    found = jd.rotate(POINTS, degrees, axis=axis, center=CENTER)
    np.testing.assert_allclose(found, turn.apply(POINTS - CENTER) + CENTER, atol=EXACT)
    middle = POINTS.mean(axis=0)
    found = jd.rotate(POINTS, degrees, axis=axis)
    np.testing.assert_allclose(found, turn.apply(POINTS - middle) + middle, atol=EXACT)


def test_translate():
    np.testing.assert_allclose(jd.translate(POINTS, CENTER), POINTS + CENTER, atol=EXACT)
    np.testing.assert_allclose(jd.translate(POINTS, POINTS), 2 * POINTS, atol=EXACT)


@pytest.mark.parametrize("along", ["x", "y", "z"])
def test_bend_and_twist_are_scipys(along):
    axis = "xyz".index(along)
    height = POINTS[:, axis]
    upper = height > (height.min() + height.max()) / 2
    assert 0 < upper.sum() < 12
    toward = "yzx"[axis]
    # From along to toward is a turn about their cross product.
    normal = np.cross(np.eye(3)[axis], np.eye(3)[(axis + 1) % 3])
    for found, direction, middle in (
        (
            jd.bend(POINTS, 50.0, along=along, toward=toward),
            normal,
            (POINTS.min(axis=0) + POINTS.max(axis=0)) / 2,
        ),
        (jd.twist(POINTS, 50.0, along=along), np.eye(3)[axis], POINTS.mean(axis=0)),
    ):
        turn = Rotation.from_rotvec(np.radians(50.0) * direction)
        want = np.where(upper[:, None], turn.apply(POINTS - middle) + middle, POINTS)
        np.testing.assert_allclose(found, want, atol=EXACT)


def test_bent_bar_ends_lie_as_in_the_thesis(bar):
    """One end stays, the other's outward normal turns from +y to +x."""
    handles = ends(bar)
    moved = np.asarray(jd.bend(bar.vertices[handles], 90.0))
    low = bar.vertices[handles][:, 1] < 75
    np.testing.assert_array_equal(moved[low], bar.vertices[handles][low])
    x, y = moved[~low, 0], moved[~low, 1]
    top = bar.vertices[handles][~low, 1]
    np.testing.assert_allclose(x, top - 75.5, atol=EXACT)
    np.testing.assert_allclose(y, 75.5 - bar.vertices[handles][~low, 0], atol=EXACT)


@pytest.mark.parametrize("motion", [jd.bend, jd.twist, jd.rotate])
def test_motions_differentiate_and_compile(motion):
    weight = jnp.asarray(np.random.default_rng(1).normal(size=POINTS.shape))
    f = jax.jit(lambda points, degrees: jnp.sum(weight * motion(points, degrees)))
    points, direction = jnp.asarray(POINTS), jnp.asarray(POINTS[::-1])
    for degrees in (0.0, 70.0):
        slope, turn = jax.grad(f, argnums=(0, 1))(points, degrees)
        h = 1e-6
        want = (f(points, degrees + h) - f(points, degrees - h)) / (2 * h)
        np.testing.assert_allclose(turn, want, rtol=FD)
        upper, lower = (f(points + s * h * direction, degrees) for s in (1, -1))
        want = (upper - lower) / (2 * h)
        np.testing.assert_allclose(jnp.sum(slope * direction), want, rtol=FD)


def test_single_precision_stays_single_and_integers_become_floats():
    low = jnp.asarray(POINTS, jnp.float32)
    for found in (jd.rotate(low, 9.0), jd.bend(low), jd.twist(low), jd.translate(low, [1, 2, 3])):
        assert found.dtype == jnp.float32
    assert jd.rotate([[1, 0, 0], [0, 1, 0]], 90).dtype == jnp.float64


def test_bad_arguments_are_named():
    bad = {
        r"points have shape \(3,\)": lambda: jd.rotate([1.0, 2, 3], 9.0),
        r"points have shape \(0, 3\)": lambda: jd.bend(np.zeros((0, 3))),
        "points are of type": lambda: jd.twist([["a", "b", "c"]]),
        "axis 'w': give": lambda: jd.rotate(POINTS, 9.0, axis="w"),
        "axis 'xy': give": lambda: jd.twist(POINTS, along="xy"),
        r"axis \[0.0, 0.0, 0.0\]": lambda: jd.rotate(POINTS, 9.0, axis=[0, 0, 0]),
        r"axis \[nan": lambda: jd.rotate(POINTS, 9.0, axis=[np.nan, 0, 0]),
        "along and toward are both 'z'": lambda: jd.bend(POINTS, along="z", toward="z"),
        r"center has shape \(2,\): give \(3,\)": lambda: jd.rotate(POINTS, 9.0, center=[0.0, 1.0]),
        r"degrees has shape \(2,\)": lambda: jd.bend(POINTS, [9.0, 8.0]),
        r"offset has shape \(2,\): give \(3,\) or \(12, 3\)": lambda: jd.translate(POINTS, [1, 2]),
    }
    for message, call in bad.items():
        with pytest.raises(jd.InputError, match=message):
            call()
