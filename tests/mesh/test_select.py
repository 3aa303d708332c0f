"""Selections, by loops over the vertices of random meshes."""

import copy
import pickle

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CUBE, bumpy_sheet, tetrahedron
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from small_meshes import MESHES

import jaxdeform as jd

X, Y, Z = range(3)


def random_mesh(seed, n=60, m=80):
    """Return random vertices in a random soup of faces, some vertices in none."""
    rng = np.random.default_rng(seed)
    faces = np.array([rng.choice(n - 5, 3, replace=False) for _ in range(m)])
    return jd.Mesh(rng.normal(size=(n, 3)) * [1, 5, 0.2], faces), rng


def by_loop(mesh, inside):
    return [k for k, p in enumerate(mesh.vertices) if inside(p)]


@pytest.mark.parametrize("seed", range(5))
def test_places_by_loops(seed):
    mesh, rng = random_mesh(seed)
    low, high = np.sort(rng.normal(size=(2, 3)) * [1, 5, 0.2], axis=0)
    box = jd.select.box(mesh, low, high)
    assert list(box) == by_loop(mesh, lambda p: all(low[a] <= p[a] <= high[a] for a in range(3)))
    assert len(jd.select.box(mesh, [-np.inf] * 3, [np.inf] * 3)) == 60
    open_box = jd.select.box(mesh, [-np.inf, 0, -np.inf], [np.inf] * 3)
    assert list(open_box) == by_loop(mesh, lambda p: p[Y] >= 0)

    point, normal = rng.normal(size=3), rng.normal(size=3)
    side = jd.select.halfspace(mesh, normal, above=point)
    assert list(side) == by_loop(mesh, lambda p: sum((p - point) * normal) > 0)
    other = jd.select.halfspace(mesh, -7 * normal, above=point)
    assert not len(side & other)
    assert len(side | other) == 60
    slab = jd.select.halfspace(mesh, "y", above=-1, below=[9, 2, 9])
    assert list(slab) == by_loop(mesh, lambda p: -1 < p[Y] < 2)
    # A number is a distance along the axis, however long the axis is given.
    assert jd.select.halfspace(mesh, [0, 5, 0], below=2) == jd.select.halfspace(mesh, "y", below=2)

    distance = [np.sqrt(sum((p - point) ** 2)) for p in mesh.vertices]
    radius = np.median(distance)
    assert list(jd.select.sphere(mesh, point, radius)) == [
        k for k in range(60) if distance[k] <= radius
    ]
    for count in (1, 7, 60):
        nearest = jd.select.nearest(mesh, point, count)
        assert list(nearest) == sorted(sorted(range(60), key=distance.__getitem__)[:count])


def test_the_faces_of_a_box_and_of_a_sphere_are_inside_and_a_plane_is_not():
    assert len(jd.select.box(CUBE, [-1, -1, -1], [1, 1, 1])) == 8
    assert len(jd.select.sphere(CUBE, [-1, -1, -1], 2.0)) == 4
    assert len(jd.select.halfspace(CUBE, "x", above=-1)) == 4
    # Equally near: the lowest indices.
    assert list(jd.select.nearest(CUBE, [0, 0, 0], 3)) == [0, 1, 2]


@pytest.mark.parametrize("seed", range(5))
def test_borders_and_components_by_loops(seed):
    mesh, _ = random_mesh(seed, m=25)
    sides = [frozenset(side) for a, b, c in mesh.faces for side in ((a, b), (b, c), (c, a))]
    border = {int(k) for side in sides if sides.count(side) == 1 for k in side}
    assert list(jd.select.border(mesh)) == sorted(border)
    start = {int(mesh.faces[0, 0]), 59}
    reached = set(start)
    while more := {int(k) for f in mesh.faces if reached & set(f.tolist()) for k in f} - reached:
        reached |= more
    assert list(jd.select.component(mesh, sorted(start))) == sorted(reached)
    assert list(jd.select.component(mesh, 59)) == [59]  # in no face
    assert not len(jd.select.border(CUBE))


@pytest.mark.parametrize("name", ["octahedron", "square"])
def test_within_is_the_distance_to_the_nearest_source(name):
    mesh = MESHES[name]()
    every = jd.geodesic_distances(mesh, range(mesh.n_vertices))
    for sources in ([0], [0, 3, 5]):
        nearest = every[:, sources].min(axis=1)
        for distance in (0.0, 0.9, 1.3, 2.0):
            assert list(jd.select.within(mesh, sources, distance)) == [
                k for k in range(mesh.n_vertices) if nearest[k] <= distance
            ]


def slivers() -> jd.Mesh:
    """A sheet whose inner points are moved, some nearly onto the edges between others."""
    sheet, rng = bumpy_sheet(), np.random.default_rng(3)
    points = sheet.vertices.copy()
    inner = ~jd.select.border(sheet).mask
    points[inner] += rng.uniform(-0.3, 0.3, (inner.sum(), 3))
    i, j, k = sheet.faces[::5].T
    low = (points[i] + points[j]) / 2 + 1e-4 * (points[k] - points[i])
    tips = len(points) + np.arange(len(i))
    rest = np.delete(sheet.faces, np.s_[::5], axis=0)
    fans = [np.stack(face, 1) for face in ((i, j, tips), (j, k, tips), (k, i, tips))]
    return jd.Mesh(np.concatenate([points, low]), np.concatenate([rest, *fans]))


@pytest.mark.parametrize("name", ["bar", "sheet", "slivers", "two bars"])
def test_within_agrees_with_all_distances(name):
    """Bounds settle most vertices: for every distance as if all had been asked for."""
    bar, rng = jd.shapes.bar(), np.random.default_rng(1)
    mesh = {"bar": lambda: bar, "sheet": bumpy_sheet, "slivers": slivers}.get(
        name,
        lambda: jd.Mesh(
            np.concatenate([bar.vertices, bar.vertices + 40]),
            np.concatenate([bar.faces, bar.faces + bar.n_vertices]),
        ),
    )()
    for count in (1, 3):
        sources = rng.choice(mesh.n_vertices, count, replace=False)
        far = jd.geodesic_distances(mesh, sources).min(axis=1)
        finite = np.sort(far[np.isfinite(far)])
        # Also exactly at vertices, and beyond all of them.
        distances = [*(finite[-1] * np.linspace(0.01, 1.1, 25)), *finite[:: finite.size // 9]]
        for distance in distances:
            sure = np.abs(far - distance) > 1e-9 * distance
            found = jd.select.within(mesh, sources, distance).mask
            np.testing.assert_array_equal(found[sure], (far <= distance)[sure])


def test_within_lies_between_straight_lines_and_paths_of_edges():
    """On two sheets side by side: never beyond the straight line, never short of the edges."""
    sheet = bumpy_sheet()
    v, n = sheet.vertices, sheet.n_vertices
    mesh = jd.Mesh(
        np.concatenate([v, v + np.array([0, 0, 0.1]), [[0, 0, 0]]]),
        np.concatenate([sheet.faces, sheet.faces + n]),
    )
    sources = jd.select.nearest(sheet, [3, 3, 0], 2)
    i, j = sheet.edges.T
    length = np.linalg.norm(v[i] - v[j], axis=1)
    graph = coo_matrix((length, (i, j)), (n, n)).tocsr()
    paths = dijkstra(graph, directed=False, indices=sources.vertices).min(axis=0)
    straight = np.linalg.norm(v[:, None] - v[sources][None], axis=2).min(axis=1)
    for distance in (1.0, 2.5, 4.0):
        found = set(jd.select.within(mesh, sources.vertices, distance))
        assert set(np.flatnonzero(paths <= distance)) <= found
        assert found <= set(np.flatnonzero(straight <= distance + 1e-9))


def test_sets(bar):
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 722)) < 0.3
    one, two = jd.select.mask(bar, a), jd.select.mask(bar, b)
    for found, want in (
        (one | two, a | b),
        (one & two, a & b),
        (one - two, a & ~b),
        (~one, ~a),
        # The other side may be a mask or indices, on either side.
        (one | b, a | b),
        (b | one, a | b),
        (b & one, a & b),
        (one - b, a & ~b),
        (b - one, b & ~a),
        (one & np.flatnonzero(b), a & b),
        (np.flatnonzero(b).tolist() | one, a | b),
        (one - jnp.asarray(b), a & ~b),
    ):
        assert isinstance(found, jd.Selection)
        np.testing.assert_array_equal(found.mask, want)
        assert found.vertices.tolist() == list(found) == np.flatnonzero(want).tolist()
        assert len(found) == want.sum()
    assert np.flatnonzero(a)[3] in one
    assert not jd.select.where(bar, "y > 200")  # an empty one is false, as an empty list
    with pytest.raises(jd.InputError, match=r"the other side: the mask has shape \(3,\)"):
        one | np.ones(3, bool)
    with pytest.raises(jd.InputError, match="the selection is of another mesh"):
        one & jd.select.border(CUBE)


@pytest.mark.parametrize(
    ("name", "use"),
    [
        ("handles", jd.precompute),
        ("free", jd.submesh),
        ("sources", jd.geodesic_distances),
        ("sources", lambda mesh, chosen: jd.select.within(mesh, chosen, 0.1)),
        ("handles", jd.bounded_biharmonic_weights),
        ("the other side", lambda mesh, chosen: jd.select.where(mesh, "x < 0") | chosen),
        ("the other side", lambda mesh, chosen: chosen | jd.select.where(mesh, "x < 0")),
    ],
)
def test_a_selection_fits_its_faces_and_no_others(name, use):
    """The square again, with its vertices in another order; and in a pose."""
    mesh = jd.shapes.square()
    order = np.random.default_rng(0).permutation(9)
    renumbered = jd.Mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    chosen = jd.select.where(mesh, "x > 0")
    assert chosen.vertices.tolist() != jd.select.where(renumbered, "x > 0").vertices.tolist()
    message = f"{name}: the selection is of another mesh .its faces name other vertices"
    with pytest.raises(jd.InputError, match=message):
        use(renumbered, chosen)
    pose = jd.Mesh(mesh.vertices @ np.diag([2.0, 1.0, 1.0]) + 5.0, mesh.faces.copy())
    use(pose, chosen)
    pair = jd.select.mask(pose, np.arange(9) < 2) | chosen
    assert list(pair) == sorted({0, 1, *chosen})


def test_a_selection_is_a_value(bar):
    mask = bar.vertices[:, 1] < 6
    one = jd.select.mask(bar, mask)
    again = jd.select.where(jd.shapes.bar(), "y < 6")
    assert one == again
    assert hash(one) == hash(again)
    assert one != ~one
    assert one != mask.tolist()
    assert pickle.loads(pickle.dumps(one)) == copy.deepcopy(one) == one
    mask[:] = False
    assert len(one) == 73
    for same in (one, pickle.loads(pickle.dumps(one)), copy.deepcopy(one), copy.copy(one)):
        assert len(same.vertices) == 73
        for array in (same.mask, same.vertices):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = False
    own = np.zeros(722, bool)
    made = jd.Selection(bar, own)
    own[3] = True  # the caller's stays his, and the selection's its own
    assert not len(made)
    assert repr(one) == "Selection(73 of 722 vertices)"
    np.testing.assert_array_equal(bar.vertices[one], bar.vertices[one.vertices])
    np.testing.assert_array_equal(jnp.asarray(one), one.vertices)
    assert np.asarray(one, np.int32).dtype == np.int32


def ways(mesh, mask):
    """Return all that may stand for these vertices."""
    return mask, mask.tolist(), jnp.asarray(mask), jd.select.mask(mesh, mask)


def test_every_choice_of_vertices_takes_masks_and_selections(bar):
    """A mask means its vertices, and never the indices 0 and 1."""
    mask = (bar.vertices[:, 1] < 6) | (bar.vertices[:, 1] > 145)
    index = np.flatnonzero(mask)
    square = jd.shapes.square()
    corners = np.isin(np.arange(9), [0, 2, 6, 8])
    goal = square.vertices[corners] * 1.1
    wanted = (
        jd.laplacian_editing(square, [0, 2, 6, 8], goal),
        jd.geodesic_distances(square, [0, 2, 6, 8]),
        jd.bounded_biharmonic_weights(square, [0, 2, 6, 8]),
    )
    for chosen in ways(bar, mask):
        assert jd.precompute(bar, chosen).handles.tolist() == index.tolist()
    for chosen in ways(square, corners):
        found = (
            jd.laplacian_editing(square, chosen, goal),
            jd.geodesic_distances(square, chosen),
            jd.bounded_biharmonic_weights(square, chosen),
        )
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
        assert jd.select.component(square, chosen) == ~jd.select.mask(square, np.zeros(9, bool))
        assert jd.select.within(square, chosen, 0) == jd.select.mask(square, corners)
    for chosen in ways(square, ~corners):
        assert jd.submesh(square, chosen).handles.tolist() == [0, 2, 6, 8]
    # Two vertices, where the mask read as indices would be vertices 0 and 1.
    four = jd.Mesh(*tetrahedron())
    assert jd.precompute(four, [False, False, True, True]).handles.tolist() == [2, 3]


def test_an_empty_selection_is_told_where_the_mesh_is(bar):
    nowhere = jd.select.where(bar, "y > 200")
    where = "x runs from -15 to 15, y from 0 to 151, z from -15 to 15"
    for call in (
        lambda: jd.precompute(bar, nowhere),
        lambda: jd.laplacian_editor(bar, nowhere),
        lambda: jd.select.within(bar, nowhere, 3),
    ):
        with pytest.raises(jd.InputError, match=where):
            call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: jd.select.box(m, [0, 2, 0], [1, 1, 1]), "low is 2 along y, above high, 1: swap"),
        (lambda m: jd.select.halfspace(m, "y"), "above and below are None: give one of them"),
        (lambda m: jd.select.halfspace(m, "v", above=1), "axis is 'v': give 'x', 'y', 'z' or a"),
        (lambda m: jd.select.halfspace(m, "y", above=[1, 2]), "above is .*a point of three on the"),
        (lambda m: jd.select.nearest(m, [0, 0, 0], 723), "whole number from 1 to 722"),
        (lambda m: jd.select.nearest(m, [0, 0]), "point is .*three finite numbers"),
        (lambda m: jd.select.sphere(m, [0, 0, 0], -1.0), "radius is -1.0: give a finite number"),
        (lambda m: jd.select.mask(m, [1] * 722), "mask has shape .* and type int64: give booleans"),
        (lambda m: jd.Selection(m, None), "mask cannot be read as numbers: it is None"),
        (lambda m: jd.Selection(m, [True, False]), r"mask has shape \(2,\) .*booleans \(722,\)"),
        (lambda m: jd.Selection(m, 3), r"mask has shape \(\) and type int64: give booleans"),
        (lambda m: jd.Selection(m, np.ones(722)), "mask has shape .* and type float64"),
        (lambda m: jd.Selection(m.vertices, np.ones(722, bool)), "mesh is a ndarray: give a jd"),
        (lambda m: jd.select.component(m, 722), "vertex 722 .*out of range: vertices are 0 to 721"),
        (lambda m: jd.select.component(m, True), "vertices: the mask has shape"),
    ],
)
def test_bad_arguments_are_told_the_next_move(bar, call, message):
    with pytest.raises(jd.InputError, match=message):
        call(bar)
