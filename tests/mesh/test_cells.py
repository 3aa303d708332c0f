"""Cells: what test_energy.py does not show of them on small meshes, and misuse."""

import copy
import pickle

import numpy as np
import pytest
from helpers import replaced

import jaxdeform as jd


def bipyramid(sides):
    angle = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    i = np.arange(sides)
    j, top, bottom = (i + 1) % sides, 0 * i + sides, 0 * i + sides + 1
    faces = np.concatenate([np.stack([i, j, top], 1), np.stack([j, i, bottom], 1)])
    return jd.Mesh(np.concatenate([rim, [[0, 0, 1], [0, 0, -1]]]), faces)


@pytest.mark.parametrize("sides", [128, 256])
def test_poles_of_high_valence_reach_each_other(sides):
    """256 paths of two steps lead from one pole to the other: 0, if counted in eight bits."""
    mesh = bipyramid(sides)
    count = np.diff(jd.rings(mesh, 2).membership.indptr)
    assert count[-2:].tolist() == [3 * sides] * 2
    count = np.diff(jd.rings(mesh, 1).membership.indptr)
    assert count[-2:].tolist() == [2 * sides] * 2


def test_rings_beyond_the_mesh_hold_all_of_it():
    mesh = bipyramid(6)
    for r in (2, 3, 10**9):
        assert (jd.rings(mesh, r).membership.toarray() == 1).all()


def test_cell_vertices_and_overlap():
    mesh = bipyramid(6)
    cells = jd.rings(mesh, np.array([1, 2, 1, 1, 1, 1, 1, 2]))
    member = cells.membership.toarray()
    np.testing.assert_array_equal(cells.overlap, member.sum(axis=0))
    inside = cells.reach.toarray() > 0
    for k in range(mesh.n_vertices):
        want = set(mesh.edges[member[k] == 1].ravel()) | {k}
        assert set(np.flatnonzero(inside[k])) == want


def test_an_unreferenced_vertex_has_an_empty_cell_with_itself_as_vertex():
    mesh = jd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], [[0, 1, 2]])
    for cells in (jd.rings(mesh, 3), jd.spokes(mesh)):
        assert cells.membership[3].nnz == 0
        assert cells.reach[3].indices.tolist() == [3]


def test_given_weights_are_kept():
    mesh = bipyramid(6)
    weights = np.linspace(-1, 1, len(mesh.edges))
    for cells in (jd.rings(mesh, 1, weights=weights), jd.spokes(mesh, weights=weights)):
        np.testing.assert_array_equal(cells.weights, weights)


def made_by_hand(mesh):
    cells = jd.spokes(mesh, weights=np.ones(len(mesh.edges)))
    return jd.Cells(mesh, np.ones(len(mesh.edges)), cells.membership.astype(float).tocoo())


@pytest.mark.parametrize("make", [lambda mesh: jd.rings(mesh, 2), jd.spokes, made_by_hand])
def test_cells_are_a_value_that_cannot_be_written(make):
    cells = make(bipyramid(6))
    for one in (cells, pickle.loads(pickle.dumps(cells)), copy.deepcopy(cells), copy.copy(cells)):
        assert one == make(bipyramid(6))
        member = one.membership
        for array in (one.weights, member.data, member.indices, member.indptr):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 3
        with pytest.raises(ValueError, match="read-only"):
            member[0, 0] = 0
        np.testing.assert_array_equal(member.toarray(), make(bipyramid(6)).membership.toarray())


def test_the_caller_s_weights_and_membership_are_copied():
    mesh = bipyramid(6)
    weights = np.linspace(-1, 1, 18)
    member = jd.spokes(mesh).membership.copy()
    by_rings, by_hand = jd.rings(mesh, weights=weights), jd.Cells(mesh, weights, member)
    weights[0] = 7
    member.data[0] = 0
    for cells in (by_rings, by_hand):
        np.testing.assert_array_equal(cells.weights, np.linspace(-1, 1, 18))
    assert (by_hand.membership != jd.spokes(mesh).membership).nnz == 0


def test_cells_made_by_hand_are_those_of_spokes():
    mesh = bipyramid(6)
    weights = np.ones(18)
    assert made_by_hand(mesh) == jd.spokes(mesh, weights=weights)
    # Zeros that are stored are no members.
    member = jd.spokes(mesh).membership.copy()
    kept = member.nnz - np.diff(member.indptr)[2]
    member.data[member.indptr[2] : member.indptr[3]] = 0
    assert jd.Cells(mesh, weights, member).overlap.sum() == kept


def test_cells_made_by_hand_are_checked():
    mesh = bipyramid(6)
    weights, member = jd.spokes(mesh).weights, jd.spokes(mesh).membership
    twice = member.copy()
    twice.data[twice.indptr[5]] = 2
    bad = {
        "mesh is a ndarray: give a jd.Mesh": (mesh.vertices, weights, member),
        "weights cannot be read as numbers: it is None": (mesh, None, member),
        r"weights have shape \(8,\): give one per row of": (mesh, np.ones(8), member),
        "the weight of edge 2 is inf": (mesh, replaced(weights, 2, np.inf), member),
        "membership is a ndarray: give a sparse matrix": (mesh, weights, member.toarray()),
        "membership is None: give a sparse": (mesh, weights, None),
        r"membership has shape \(18, 8\): give .*\(8, 18\)": (mesh, weights, member.T),
        "the membership of cell 5 holds 2: give 1": (mesh, weights, twice),
    }
    for message, arguments in bad.items():
        with pytest.raises(jd.InputError, match=message):
            jd.Cells(*arguments)


def test_bad_arguments_are_named():
    mesh = bipyramid(6)
    bad_weight = np.ones(18)
    bad_weight[3] = np.nan
    bad = {
        "r must be an integer": lambda: jd.rings(mesh, 1.5),
        r"r has shape \(2,\)": lambda: jd.rings(mesh, [1, 2]),
        "r = 0 at vertex 5": lambda: jd.rings(mesh, [1, 1, 1, 1, 1, 0, 1, 1]),
        "r = -1 at vertex 0": lambda: jd.rings(mesh, -1),
        r"weights have shape \(8,\)": lambda: jd.rings(mesh, 1, weights=np.ones(8)),
        "weight of edge 3 is nan": lambda: jd.spokes(mesh, weights=bad_weight),
    }
    for message, call in bad.items():
        with pytest.raises(jd.InputError, match=message):
            call()
