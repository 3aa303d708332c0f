"""Polygons cut into triangles, against areas and brute force."""

from itertools import combinations

import numpy as np
import pytest
from helpers import CASES, EXACT
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxdeform as jd
from jaxdeform._mesh.ears import cut_ears


def shoelace(corners):
    """Return the signed area of a polygon in the plane."""
    x, y = np.asarray(corners, float).T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def loaded(tmp_path, points, *polygons):
    path = tmp_path / "m.off"
    lines = ["OFF", f"{len(points)} {len(polygons)} 0"]
    lines += [" ".join(map(repr, map(float, point))) for point in points]
    lines += [" ".join(map(str, [len(face), *face])) for face in polygons]
    path.write_text("\n".join(lines))
    return jd.load_mesh(path)


def in_space(flat, seed=0):
    """Return the points turned and moved in space."""
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    return np.column_stack([flat, np.zeros(len(flat))]) @ turn.T + [3, -5, 7]


def check_cut(flat, faces):
    """Each triangle is on the polygon's side, and together they cover its area once."""
    flat = np.asarray(flat, float)
    areas = np.array([shoelace(flat[face]) for face in faces])
    assert len(faces) == len(flat) - 2
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(), shoelace(flat), rtol=1e-9)
    # The border is the polygon's own; inside, each edge has two sides.
    edges = [tuple(map(int, (f[k], f[(k + 1) % 3]))) for f in faces for k in range(3)]
    border = [edge for edge in edges if edge[::-1] not in edges]
    assert sorted(border) == sorted((k, (k + 1) % len(flat)) for k in range(len(flat)))


def star(n, seed):
    """Return a polygon around the origin, with corners far in and far out."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(0, 0.8, n)) / n
    return rng.uniform(0.1, 1, n)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)


def comb(teeth):
    """Return a polygon with narrow teeth that almost touch its back."""
    up = [[(k, 1.0), (k + 0.4, 0.01), (k + 0.6, 0.01)] for k in range(teeth)]
    return [(0, 0), (teeth, 0), (teeth, 1), *[p for tooth in up[::-1] for p in tooth[::-1]]]


def spiral(n):
    """Return a band that winds three times."""
    angle = np.linspace(0, 6 * np.pi, n)
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    outer = (1.9 + angle / 6)[:, None] * circle
    return np.concatenate([outer, (outer - 0.5 * circle)[::-1]])


FINE = [*[(k / 20, 0) for k in range(20)], *[(1, k / 20) for k in range(20)], (1, 1), (0, 1)]
SHAPES = {
    "arrow": [(0, 0), (2, 0), (0.5, 0.5), (0, 2)],
    "L": [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)],
    # Corners in the middle of sides, as where smaller faces meet a larger one.
    "triangle": [(0, 0), (1, 0), (2, 0), (3, 0), (0, 3)],
    "square": [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)],
    "fine square": FINE,
    "U": [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)],
    "comb": comb(5),
    "long comb": comb(40),
    "spiral": spiral(15),
    "long spiral": spiral(100),
    "disk": [(np.cos(a), np.sin(a)) for a in np.linspace(0, 6, 60)],
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("turned", [False, True])
def test_a_concave_polygon_is_covered_once(tmp_path, name, turned):
    flat = np.array(SHAPES[name], float)[:: -1 if turned else 1]
    mesh = loaded(tmp_path, in_space(flat), range(len(flat)))
    if shoelace(flat) < 0:  # seen from behind
        flat = flat * [1, -1]
    check_cut(flat, mesh.faces)


@settings(max_examples=80, deadline=None)
@given(st.integers(5, 120), st.integers(0, 10**6))
def test_random_stars_are_covered_once(n, seed):
    flat = star(n, seed)
    check_cut(flat, cut_ears(flat))


@pytest.mark.parametrize("n", [31, 32, 33, 34])
def test_both_sides_of_the_size_where_the_way_changes(tmp_path, n):
    flat = star(n, n)
    check_cut(flat, loaded(tmp_path, in_space(flat), range(n)).faces)


def every_way(corners):
    """Return all ways to cut a polygon, as lists of triangles."""
    if len(corners) < 3:
        return [[]]
    first, *middle, last = corners
    return [
        [(first, k, last), *left, *right]
        for at, k in enumerate(middle, 1)
        for left in every_way(corners[: at + 1])
        for right in every_way(corners[at:])
    ]


@pytest.mark.parametrize("seed", range(12))
def test_the_diagonals_are_the_shortest_that_stay_inside(tmp_path, seed):
    n = 5 + seed % 4
    flat = star(n, 100 + seed)
    points = in_space(flat, seed)

    def length(faces):
        edges = {tuple(sorted(pair)) for face in faces for pair in combinations(face, 2)}
        return sum(np.linalg.norm(points[i] - points[j]) for i, j in edges)

    ways = every_way(list(range(n)))
    inside = [way for way in ways if all(shoelace(flat[list(face)]) > 1e-9 for face in way)]
    found = loaded(tmp_path, points, range(n)).faces.tolist()
    # Equal up to the bias towards a fan.
    np.testing.assert_allclose(length(found), min(map(length, inside)), rtol=1e-5)


def test_a_quad_is_cut_along_its_shorter_diagonal(tmp_path):
    points = [(0, 0, 0), (2, 0, 0.5), (3, 1, 0), (1, 1, 0.5)]  # not planar
    assert loaded(tmp_path, points, range(4)).faces.tolist() == [[0, 1, 3], [1, 2, 3]]
    assert loaded(tmp_path, points, (1, 2, 3, 0)).faces.tolist() == [[1, 2, 3], [1, 3, 0]]


def test_equal_diagonals_are_cut_alike(tmp_path):
    """As a fan, also where the numbers are rounded: a regular grid stays regular."""
    points = np.random.default_rng(0).normal(size=(50, 3)).repeat(4, axis=0) * 1e3
    points += np.tile([(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)], (50, 1))
    faces = loaded(tmp_path, points, *np.arange(200).reshape(-1, 4).tolist()).faces
    assert (faces.reshape(-1, 6) % 4).tolist() == [[0, 1, 2, 0, 2, 3]] * 50


@pytest.mark.parametrize("on_a_side", [0, 33])
def test_a_hole_that_is_cut_open(tmp_path, on_a_side):
    """The border runs in and back, through corners in the same places."""
    outer = [(0, 0), *[(4 * k / (on_a_side + 1), 0) for k in range(1, on_a_side + 1)], (4, 0)]
    hole = [(1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
    rim = np.array([*outer, (4, 4), (0, 4), (0, 0), *hole], float)
    mesh = loaded(tmp_path, in_space(rim), range(len(rim)))
    areas = np.array([shoelace(rim[face]) for face in mesh.faces])
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(), 16 - 4, rtol=1e-9)


@pytest.mark.parametrize("n", [5, 81])
def test_a_polygon_that_crosses_itself_is_cut_somehow(tmp_path, n):
    angle = np.arange(n) * 2 * np.pi * (n // 2) / n
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    mesh = loaded(tmp_path, points, range(n))
    assert mesh.n_faces == n - 2
    assert mesh.referenced.all()


def test_polygons_of_all_sizes_in_their_order(tmp_path):
    flat = np.array([(np.cos(a), np.sin(a)) for a in np.arange(40) * 2 * np.pi / 40])
    polygons = [(0, 1, 2), range(40), (5, 6, 7, 8), (1, 2, 3), range(10, 16), (30, 31, 32, 33)]
    faces = loaded(tmp_path, in_space(flat), *polygons).faces
    at = 0
    for polygon in polygons:
        own = faces[at : at + len(polygon) - 2]
        assert set(own.ravel()) == set(polygon)
        at += len(own)
    assert at == len(faces)


@pytest.mark.parametrize("scale", [1e-130, 1e-30, 1e30, 1e130])
def test_a_cut_does_not_depend_on_the_unit(tmp_path, scale):
    points = in_space(np.array(SHAPES["U"], float))
    want = loaded(tmp_path, points, range(8)).faces
    np.testing.assert_array_equal(loaded(tmp_path, points * scale, range(8)).faces, want)


def test_a_cut_far_from_the_origin(tmp_path):
    flat = np.array(SHAPES["U"], float) / 128
    points = np.column_stack([flat, np.zeros(8)]) + np.array([412_345.0, 5_654_321.0, 0])
    check_cut(flat, loaded(tmp_path, points, range(8)).faces)


def test_polygons_of_the_cases():
    quads = jd.load_mesh(CASES / "02_quads.obj")
    assert (quads.n_vertices, quads.n_faces) == (6, 4)
    a, b, c = (quads.vertices[quads.faces[:, k]] for k in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a), [[0, 0, 1]] * 4, atol=EXACT)
    assert jd.load_mesh(CASES / "24_quad.off").n_faces == 2


def test_too_many_corners_are_refused(tmp_path):
    angle = np.arange(5_001) * 2 * np.pi / 5_001
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    with pytest.raises(jd.InputError, match="face 0 has 5001 corners: cut it into triangles"):
        loaded(tmp_path, points, range(5_001))
