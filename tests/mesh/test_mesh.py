"""Meshes: what is refused, copied, frozen and derived."""

import copy
import pickle

import numpy as np
import pytest
from helpers import replaced, tetrahedron

import jaxdeform as jd


def test_bad_arrays_are_named():
    v, f = tetrahedron()
    bad = {
        r"vertex 2 is \[0.0, nan, 0.0\] \(1 in total\)": (
            replaced(v, (2, 1), np.nan),
            f,
        ),
        r"vertex 0 is \[inf": (replaced(v, (0, 0), np.inf), f),
        r"face 1 \[0, 1, 4\] names a vertex out of range": (v, replaced(f, (1, 2), 4)),
        r"face 3 \[-1, 3, 2\]": (v, replaced(f, (3, 0), -1)),
        r"face 2 \[1, 1, 3\] repeats a vertex: drop": (v, replaced(f, (2, 1), 1)),
        r"face 0 \[0, 2, 1\] has no area: drop": (v * [1, 0, 0], f),
        r"vertices have shape \(4, 2\)": (v[:, :2], f),
        r"vertices have shape \(0,\)": ([], f),
        r"faces have shape \(0,\)": (v, []),
        r"faces have shape \(1, 4\)": (v, [[0, 1, 2, 3]]),
        "faces must be integers, got float64": (v, f * 1.0),
        "faces cannot be read as numbers": (v, [[0, 1, 2], [0, 1]]),
        "vertices cannot be read as numbers": ([["a", "b", "c"]], f),
    }
    for message, (vertices, faces) in bad.items():
        with pytest.raises(jd.InputError, match=message) as error:
            jd.Mesh(vertices, faces)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("scale", [1e-130, 1.0, 1e130])
def test_what_has_no_area_does_not_depend_on_the_unit(scale):
    thin = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]])
    jd.Mesh(scale * thin, [[0, 1, 2]])
    flat = np.array([[0, 0, 0], [1, 1, 1], [3, 3, 3]]) / 3
    with pytest.raises(jd.InputError, match="no area"):
        jd.Mesh(scale * flat, [[0, 1, 2]])


def test_the_caller_s_arrays_are_copied_and_the_mesh_s_are_frozen():
    v, f = tetrahedron()
    mesh = jd.Mesh(v, f)
    v[:] = 7
    assert mesh.vertices[1].tolist() == [1, 0, 0]
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1
    with pytest.raises(AttributeError):
        mesh.faces = f


@pytest.mark.parametrize("name", ["edges", "referenced", "components", "center"])
def test_what_is_derived_of_a_mesh_is_frozen_too(name):
    mesh = jd.Mesh(*tetrahedron())
    for one in (mesh, pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh)):
        before = getattr(one, name).copy()
        with pytest.raises(ValueError, match="read-only"):
            getattr(one, name)[0] = 5
        np.testing.assert_array_equal(getattr(one, name), before)


def test_edges_are_each_once_and_sorted(bar):
    pairs = {tuple(sorted((int(f[i]), int(f[i - 1])))) for f in bar.faces for i in range(3)}
    assert bar.edges.tolist() == sorted(map(list, pairs))
