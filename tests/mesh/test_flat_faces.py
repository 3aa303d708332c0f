"""Faces without area: kept, and without a part in the energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, NO_SADDLES, TWENTY
from scipy.spatial.transform import Rotation

import jaxdeform as jd


@pytest.fixture
def pair():
    """A square of 3 x 3 vertices, and the same with flat faces and a vertex that has no other."""
    plain = jd.shapes.square()
    v = np.concatenate([plain.vertices, [plain.vertices[0] / 2 + plain.vertices[1] / 2]])
    faces = [[0, 1, 2], *plain.faces[:4], [9, 1, 0], *plain.faces[4:], [6, 8, 7]]
    return jd.Mesh(v, plain.faces), jd.Mesh(v, faces)


def test_their_edges_weigh_nothing(pair):
    plain, mesh = pair
    assert mesh.n_faces == plain.n_faces + 3
    np.testing.assert_array_equal(mesh.edges, plain.edges)
    np.testing.assert_array_equal(jd.cotangent_weights(mesh), jd.cotangent_weights(plain))
    np.testing.assert_array_equal(mesh.referenced, np.arange(10) < 9)
    np.testing.assert_array_equal(mesh.solid_faces, plain.faces)


@pytest.mark.parametrize("normals", [False, True])
def test_a_mesh_deforms_as_without_them(pair, normals):
    handles = np.array([0, 1, 2, 6, 7, 8])
    targets = pair[0].vertices[handles] + np.outer(handles > 2, [0.0, 0.0, 1.0])
    poses = []
    for mesh in pair:
        problem = jd.precompute(mesh, handles)
        out = jd.deform(problem, targets, 1.0, solver=TWENTY, normals=normals)
        poses.append(np.asarray(out.vertices))
    np.testing.assert_allclose(poses[1], poses[0], atol=EXACT)
    # The vertex that has no other face stays.
    np.testing.assert_allclose(poses[1][9], pair[1].vertices[9], atol=EXACT)


@pytest.mark.slow
def test_derivatives_to_the_rest_shape_leave_them_out(pair):
    # Turned, so that rounding gives the flat faces an area.
    turn = Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix()
    turned = [jd.Mesh(m.vertices @ turn.T, m.faces) for m in pair]
    handles = np.array([0, 1, 2, 6, 7, 8])
    targets = turned[0].vertices[handles] + np.outer(handles > 2, [0.0, 0.0, 1.0])
    slopes = []
    for mesh in turned:
        problem = jd.precompute(mesh, handles)

        def height(rest, problem=problem):
            out = jd.deform(problem, targets, 1.0, rest=rest, solver=NO_SADDLES)
            return jnp.sum(out.vertices[4] ** 2)

        slopes.append(jax.grad(height)(jnp.asarray(mesh.vertices)))
    assert np.abs(slopes[0]).max() > 0.01
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=FD, atol=FD * np.abs(slopes[0]).max())


def test_files_keep_them_and_inspect_tells_of_them(tmp_path, pair):
    _, mesh = pair
    jd.save_mesh(tmp_path / "m.off", mesh)
    back = jd.load_mesh(tmp_path / "m.off")
    assert back == mesh
    text = str(jd.inspect(back))
    assert (
        "- 3 faces have no area (face 0): edges weigh nothing there; jd.repair drops such faces"
        in text
    )
    assert "- 1 vertex belongs to no face with an area: left in place" in text
    assert jd.repair(back)[0].n_faces == pair[0].n_faces


def test_pieces_and_skinning_weights_leave_them_out(pair):
    plain, mesh = pair
    pieces = [jd.submesh(m, [4]) for m in pair]
    np.testing.assert_array_equal(pieces[1].mesh.faces, pieces[0].mesh.faces)
    np.testing.assert_array_equal(pieces[1].cells.weights, pieces[0].cells.weights)
    distances = [jd.geodesic_distances(m, [0, 8]) for m in pair]
    np.testing.assert_array_equal(distances[1], distances[0])
    with pytest.raises(jd.InputError, match="vertex 9 belongs to no face"):
        jd.bounded_biharmonic_weights(mesh, [0, 8], [0, 1])
    with pytest.raises(jd.InputError, match="the cage has faces without area"):
        jd.mean_value_coordinates(plain.vertices, mesh)
