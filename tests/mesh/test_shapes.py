"""Generated meshes against what makes a good mesh."""

from functools import partial

import igl
import numpy as np
import pytest
from helpers import EXACT

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


@pytest.mark.parametrize("count", [4999, 0, -1, 5000.5, "6000", True, np.nan, np.inf, None, [6000]])
def test_octopus_of_a_bad_size(count):
    with pytest.raises(jd.InputError, match="octopus"):
        jd.shapes.octopus(count)
