"""Inspection and repair, against brute force."""

from collections import Counter

import igl
import numpy as np
import pytest
from helpers import EXACT, real_mesh, replaced, tetrahedron
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxdeform as jd


@st.composite
def soups(draw):
    """Vertices on a small grid (so that many coincide) and any faces among them."""
    n = draw(st.integers(3, 12))
    point = st.tuples(*[st.sampled_from([-0.0, 0.0, 1.0, 2.0])] * 3)
    v = draw(st.lists(point, min_size=n, max_size=n))
    face = st.tuples(*[st.integers(0, n - 1)] * 3)
    return np.array(v), np.array(draw(st.lists(face, min_size=1, max_size=15)))


def area(corners):
    return np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))


@settings(max_examples=150, deadline=None)
@given(soups())
def test_repair_is_what_brute_force_says(soup):
    v, f = soup
    want = {frozenset(map(tuple, v[face] + 0.0)) for face in f if area(v[face]) > 0}
    if not want:
        with pytest.raises(jd.InputError, match="no face with an area"):
            jd.repair(soup)
        return
    mesh, new = jd.repair(soup)
    found = [frozenset(map(tuple, mesh.vertices[face])) for face in mesh.faces]
    assert Counter(found) == Counter(want)
    # The first of equal faces stays, turned as it was.
    kept = {tuple(new[face]) for face in f if (new[face] >= 0).all()}
    assert {tuple(face) for face in mesh.faces} <= kept
    assert len({tuple(p) for p in mesh.vertices}) == mesh.n_vertices
    assert set(mesh.faces.ravel()) == set(range(mesh.n_vertices))
    used = set().union(*want)
    for old, index in enumerate(new):
        if tuple(v[old] + 0.0) in used:
            np.testing.assert_array_equal(mesh.vertices[index], v[old])
        else:
            assert index == -1
    again, same = jd.repair(mesh)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_array_equal(same, np.arange(mesh.n_vertices))


def test_repair_leaves_a_sound_mesh_and_reads_files(tmp_path, bar):
    jd.save_mesh(tmp_path / "bar.off", bar)
    for given_ in (bar, tmp_path / "bar.off", (bar.vertices, bar.faces)):
        mesh, new = jd.repair(given_)
        np.testing.assert_array_equal(mesh.vertices, bar.vertices)
        np.testing.assert_array_equal(mesh.faces, bar.faces)
        np.testing.assert_array_equal(new, np.arange(722))
    with pytest.raises(jd.InputError, match="out of range"):
        jd.repair((bar.vertices[:9], bar.faces))
    with pytest.raises(jd.InputError, match="give a Mesh, a pair"):
        jd.repair(7)


def defects():
    """Name of the finding -> (number in it, vertices, faces), on a tetrahedron or two."""
    v, f = tetrahedron()
    w = tetrahedron(5.0)[0]
    two = np.concatenate([v, w]), np.concatenate([f, f + 4])
    # The second tetrahedron's corner 0 moved onto the first one's corner 3, and joined with it.
    touching = np.concatenate([v, w[1:] - w[0] + v[3]])
    joined = np.array([3, 4, 5, 6])[f]
    # Three wings on one edge: the third page of a book.
    book = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.5], [-1, 1, 0.5], [-1, -1, 0.5]])
    return {
        "": (0, v, f),
        "face repeats a vertex": (1, v, [*f, [0, 0, 1]]),
        "face has no area": (1, [*v, [0.5, 0.5, 0]], [*f, [1, 2, 4]]),
        "vertices belong to no face": (2, [*v, [9, 9, 9], [8, 8, 8]], f),
        "face is repeated": (1, v, [*f, [1, 0, 2]]),
        "further connected component": (1, *two),
        "edges lie on the border": (3, v, f[1:]),
        "vertex lies exactly on another": (1, [*v, v[0]], replaced(f, (0, 0), 4)),
        "edge has more than two faces": (1, book, [[0, 1, 2], [0, 1, 3], [0, 1, 4]]),
        "vertex joins surfaces that meet nowhere else": (1, touching, [*f, *joined]),
        "edges have faces of opposite orientation": (3, v, replaced(f, 0, f[0, ::-1])),
        "closed component faces inwards": (1, v, f[:, ::-1]),
        "edge has a negative cotangent weight": (
            1,
            [[0, 0, 0], [2, 0, 0], [1, 0.5, 0], [1, -0.5, 0]],
            [[0, 1, 2], [1, 0, 3]],
        ),
        "angle is below 1 degree": (
            1,
            [[0, 0, 0], [100, 0, 0], [100, 1, 0]],
            [[0, 1, 2]],
        ),
    }


# What a defect brings along by its nature: an open mesh has a border, and so on.
BESIDES = {
    "face has no area": {"vertex belongs to no face with an area: left in place"},
    "vertex lies exactly on another": {"edges lie on the border"},
    "edge has more than two faces": {"edges lie on the border"},
    "edge has a negative cotangent weight": {"edges lie on the border"},
    "angle is below 1 degree": {"edges lie on the border"},
}


@pytest.mark.parametrize("name", defects())
def test_each_defect_is_found_and_no_other(name):
    count, v, f = defects()[name]
    found = {}
    for finding in jd.inspect((v, f)).findings:
        number, _, what = finding.partition(" ")
        found[next((d for d in defects() if d and what.startswith(d)), what)] = int(number)
    assert set(found) - BESIDES.get(name, set()) == ({name} if name else set())
    assert not name or found[name] == count


def test_an_unusable_mesh_is_reported_not_raised():
    v, f = tetrahedron()
    for vertices, faces in ((replaced(v, 0, np.nan), f), (v, f + 1)):
        (finding,) = jd.inspect((vertices, faces)).findings
        assert finding.startswith("Unusable: ")


def fans(faces, vertex):
    """Walk from face to face over the edges at a vertex, and count the walks needed."""
    left = [set(map(int, face)) - {vertex} for face in faces if vertex in face]
    count = 0
    while left:
        count += 1
        reached = left.pop()
        while any(face & reached for face in left):
            for face in [face for face in left if face & reached]:
                left.remove(face)
                reached = reached | face
    return count


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10**6))
def test_non_manifold_vertices_by_brute_force(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 9))
    f = np.array([rng.choice(n, 3, replace=False) for _ in range(rng.integers(1, 9))])
    f = f[np.unique(np.sort(f, axis=1), axis=0, return_index=True)[1]]
    want = sum(fans(f, k) > 1 for k in range(n))
    found = [s for s in jd.inspect((rng.normal(size=(n, 3)), f)).findings if "meet nowhere" in s]
    assert found == [] if want == 0 else found[0].startswith(f"{want} vert")


def test_measures(bar):
    counts = jd.inspect(bar).counts
    assert (counts["vertices"], counts["faces"], counts["edges"]) == (722, 1440, 2160)
    assert (counts["components"], counts["border edges"]) == (1, 0)
    assert counts["Euler characteristic"] == 2
    length = np.linalg.norm(np.diff(bar.vertices[bar.edges], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(counts["shortest edge"], length.min(), rtol=EXACT)
    np.testing.assert_allclose(counts["longest edge"], length.max(), rtol=EXACT)
    angles = igl.internal_angles(bar.vertices, bar.faces)
    np.testing.assert_allclose(counts["smallest angle"], np.degrees(angles.min()), rtol=1e-9)
    np.testing.assert_allclose(counts["largest angle"], np.degrees(angles.max()), rtol=1e-9)
    diagonal = np.sqrt(30**2 + 151**2 + 30**2)
    np.testing.assert_allclose(counts["bounding box diagonal"], diagonal, rtol=EXACT)


@pytest.mark.parametrize("name", ["fan3.obj", "hourglass_ico.obj", "octopus_10173.off"])
def test_real_meshes_are_reported(name):
    mesh = real_mesh(name)
    text = " ".join(jd.inspect(mesh).findings)
    expected = {
        "fan3.obj": "1 edge has more than two faces",
        "hourglass_ico.obj": "1 vertex joins surfaces",
        "octopus_10173.off": "angles are below 1 degree",
    }
    assert expected[name] in text
    assert ("surfaces that meet nowhere" in text) == (name == "hourglass_ico.obj")
