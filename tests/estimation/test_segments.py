"""Parts found in a field: cuts and divisions by brute force, known fields, and real estimates."""

from itertools import combinations, product

import numpy as np
import pytest
import scipy.sparse as sp
from helpers import EXACT, bumpy_sheet, noisy, replaced
from scipy.sparse.linalg import spsolve

import jaxdeform as jd
from jaxdeform._estimation.graph_cut import cheapest_side
from jaxdeform._estimation.segments import _Borders, _divide, _refine

# ---------------------------------------------------------------- brute force


@pytest.mark.parametrize("seed", range(5))
def test_the_cut_is_the_best_of_all_choices(seed):
    draw = np.random.default_rng(seed)
    edges = np.array([pair for pair in combinations(range(10), 2) if draw.uniform() < 0.4])
    # One node that nothing moves must not blur the prices of the others.
    gain, price = draw.normal(size=10), draw.uniform(size=len(edges))
    gain[0] = 1e9

    def gained(chosen):
        cut = chosen[edges[:, 0]] != chosen[edges[:, 1]]
        return gain[chosen].sum() - price[cut].sum()

    best = max((np.array(each) for each in product([False, True], repeat=10)), key=gained)
    np.testing.assert_array_equal(cheapest_side(gain, edges, price), best)


def weighted_variance(value, weight, parts):
    groups = [parts == part for part in np.unique(parts)]
    means = [np.average(value[group], weights=weight[group]) for group in groups]
    return sum(
        weight[group] @ (value[group] - mean) ** 2
        for group, mean in zip(groups, means, strict=True)
    )


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_values_are_divided_with_the_least_variance(k):
    draw = np.random.default_rng(k)
    value, weight = draw.normal(size=12), draw.uniform(size=12)
    order = np.argsort(value)
    least = np.inf
    for cuts in combinations(range(1, 12), k - 1):
        parts = np.empty(12, int)
        parts[order] = np.searchsorted(cuts, np.arange(12), side="right")
        least = min(least, weighted_variance(value, weight, parts))
    found = _divide(value, weight, k)
    assert len(np.unique(found)) == k
    np.testing.assert_allclose(weighted_variance(value, weight, found), least, rtol=EXACT)


def test_many_values_are_divided_into_the_right_groups():
    """More values than places to divide at: two outliers are still told apart."""
    value = np.concatenate([1e-3 * np.random.default_rng(0).normal(size=5000), [5.0, 9.0]])
    parts = _divide(value, np.ones(5002), 3)
    np.testing.assert_array_equal(parts, np.repeat([0, 1, 2], [5000, 1, 1]))


def test_two_parts_are_the_best_of_all_for_their_values():
    """Over all 512 ways to divide a square of nine vertices, at the values that were found."""
    mesh, draw = jd.shapes.square(), np.random.default_rng(0)
    compared = 0
    for _ in range(10):
        value, weight = draw.normal(size=9), draw.uniform(0.2, 1.0, 9)
        lengths = 0.3 * draw.uniform(size=len(mesh.edges))
        parts = _refine(value, weight, _divide(value, weight, 2), mesh.edges, lengths)
        if len(np.unique(parts)) == 2:
            center = np.bincount(parts, weight * value) / np.bincount(parts, weight)
            cost = weight[:, None] * (value[:, None] - center) ** 2
            borders = _Borders(cost, mesh.edges, np.ptp(center) ** 2 * lengths)
            least = min(borders.total(np.array(each)) for each in product([0, 1], repeat=9))
            np.testing.assert_allclose(borders.total(parts), least, rtol=1e-6)
            compared += 1
    assert compared >= 5


# ---------------------------------------------------------------- known fields


def in_thirds(mesh, values):
    """Return the third of each vertex along y, and the field with these values."""
    third = np.digitize(mesh.vertices[:, 1], [50.0, 100.0])
    return third, np.array(values)[third]


@pytest.mark.parametrize("deviation", [0.0, 0.3, 1.5])
def test_a_band_is_found_through_noise(bar, deviation):
    """A factor of 100, and noise of up to a third of it at every vertex. Both ends are one part."""
    third, field = in_thirds(bar, [0.3, 30.0, 0.3])
    noise = deviation * np.random.default_rng(0).standard_normal(bar.n_vertices)
    parts = jd.segment_rigidity(bar, field * np.exp(noise), 2)
    np.testing.assert_array_equal(parts, third == 1)
    assert parts.dtype == np.int32


@pytest.mark.parametrize("values", [[0.05, 20.0, 1.0], [1.0, 20.0, 0.05], [0.05, 1.0, 20.0]])
def test_no_seam_is_left_where_a_blurred_field_passes_a_third_value(bar, values):
    third, field = in_thirds(bar, values)
    i, j = bar.edges.T
    graph = sp.csr_matrix((np.ones(len(i)), (i, j)), shape=(bar.n_vertices,) * 2)
    laplacian = sp.csgraph.laplacian(graph + graph.T).tocsc()
    blurred = spsolve(sp.identity(bar.n_vertices, format="csc") + 2.0 * laplacian, np.log(field))
    blurred += 0.1 * np.random.default_rng(0).standard_normal(bar.n_vertices)
    expected = np.argsort(np.argsort(values))[third]
    np.testing.assert_array_equal(jd.segment_rigidity(bar, np.exp(blurred), 3), expected)
    if values[1] == 20.0:  # by their values alone, vertices of the seam are in a third part
        assert (_divide(blurred, np.ones(bar.n_vertices), 3) != expected).sum() > 20


def test_vertices_of_which_nothing_is_known_do_not_decide(bar):
    third, field = in_thirds(bar, [0.3, 30.0, 0.3])
    unknown = np.random.default_rng(0).uniform(size=bar.n_vertices) < 0.3
    field[unknown] = 1e6
    interval = field[:, None] * np.array([0.5, 2.0])
    interval[unknown] = [0.0, np.inf]
    parts = jd.segment_rigidity(bar, field, 2, interval=interval)
    np.testing.assert_array_equal(parts, third == 1)
    assert (jd.segment_rigidity(bar, field, 2) != parts).sum() > 100


def test_parts_do_not_depend_on_numbering_or_unit(bar):
    draw = np.random.default_rng(0)
    field = np.exp(draw.standard_normal(bar.n_vertices) + (bar.vertices[:, 1] > 70))
    interval = field[:, None] * np.exp(draw.uniform(0.1, 2.0, (bar.n_vertices, 1)) * [-1.0, 1.0])
    parts = jd.segment_rigidity(bar, field, 3, interval=interval)
    assert len(np.unique(parts)) == 3
    order = draw.permutation(bar.n_vertices)  # old vertex of each new one
    mesh = jd.Mesh(1e-3 * bar.vertices[order], np.argsort(order)[bar.faces])
    again = jd.segment_rigidity(mesh, 1e-6 * field[order], 3, interval=1e-6 * interval[order])
    np.testing.assert_array_equal(again, parts[order])


@pytest.mark.parametrize("k", [1, 2, 5, 9])
def test_there_are_as_many_parts_as_asked_for_from_soft_to_stiff(k):
    """Also where the field has no parts, and borders would rather swallow them."""
    mesh = bumpy_sheet()
    field = np.exp(0.1 * np.random.default_rng(0).standard_normal(mesh.n_vertices))
    parts = jd.segment_rigidity(mesh, field, k)
    np.testing.assert_array_equal(np.unique(parts), np.arange(k))
    means = [np.log(field[parts == part]).mean() for part in range(k)]
    assert means == sorted(means)


def test_a_vertex_without_a_face_belongs_to_the_part_of_its_value():
    flat = bumpy_sheet()
    mesh = jd.Mesh(np.concatenate([flat.vertices, [[0.0, 0.0, 9.0]]]), flat.faces)
    field = np.append(np.where(flat.vertices[:, 0] > 3, 10.0, 1.0), 9.0)
    parts = jd.segment_rigidity(mesh, field, 2)
    np.testing.assert_array_equal(parts, field > 5)


# ---------------------------------------------------------------- misuse


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"field": np.ones(3)}, r"field has shape \(3,\): give one rigidity per vertex, \(56,\)"),
        ({"field": np.ones((56, 2))}, r"field has shape \(56, 2\)"),
        ({"field": 1.0}, r"field has shape \(\)"),
        ({"field": replaced(np.ones(56), 7, np.nan)}, "field is nan at vertex 7: it must be fin"),
        ({"field": replaced(np.ones(56), 7, np.inf)}, "field is inf at vertex 7"),
        ({"field": replaced(np.ones(56), 7, 0.0)}, r"field is 0\.0 at vertex 7: .* above 0"),
        ({"field": np.ones(56)}, "k is 2, but the field has only 1 different .* up to 1"),
        ({"k": 0}, "k is 0: give a whole number from 1 to 56"),
        ({"k": 57}, "k is 57: give a whole number from 1 to 56"),
        ({"k": 2.0}, "k is 2.0: give a whole number"),
        ({"interval": np.ones((56, 3))}, r"interval has shape \(56, 3\): .* \(56, 2\)"),
        ({"interval": np.full((56, 2), np.nan)}, "the interval of vertex 0 is nan to nan"),
        ({"interval": np.tile([2.0, 1.0], (56, 1))}, r"vertex 0 is 2\.0 to 1\.0: .* lower end fir"),
        ({"interval": np.tile([-1.0, 1.0], (56, 1))}, r"vertex 0 is -1\.0 to 1\.0: give 0 or more"),
        ({"interval": np.tile([0.0, 1.0], (56, 1))}, "every vertex is open, .*: give more poses"),
        ({"mesh": np.ones((56, 3))}, "mesh is a"),
    ],
)
def test_misuse_is_refused(change, match):
    good = {"mesh": bumpy_sheet(), "field": np.arange(1.0, 57.0), "k": 2, "interval": None}
    jd.segment_rigidity(**good)
    with pytest.raises(jd.InputError, match=match):
        jd.segment_rigidity(**good | change)


# ---------------------------------------------------------------- from poses to parts


@pytest.mark.slow
def test_a_band_is_found_in_the_field_that_a_pose_tells(bar, bar_problem, bar_targets):
    """One pose with noise: the field, its parts, and their rigidities; one part does not do."""
    third, field = in_thirds(bar, [0.3, 30.0, 0.3])
    pose = np.asarray(jd.deform(bar_problem, bar_targets, field).vertices)
    seen = noisy(bar, pose, 0)
    found = jd.estimate_rigidity_field(bar_problem, seen, targets=bar_targets, smoothness=1e-6)
    fits = []
    for k in (1, 2):
        parts = jd.segment_rigidity(bar, found.field, k, interval=found.interval)
        fits.append(jd.estimate_rigidity(bar_problem, seen, parts=parts, targets=bar_targets))
    np.testing.assert_array_equal(parts, third == 1)
    assert [fit.ok for fit in fits] == [False, True]
    np.testing.assert_allclose(fits[1].rigidity, [0.3, 30.0], rtol=0.02)
