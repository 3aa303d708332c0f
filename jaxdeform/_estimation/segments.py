"""Regions found in a field of rigidity, as `estimate_rigidity` takes them for ``parts``.

The field that is constant in each of k parts and nearest to the given one, where the border between
parts costs its length: the piecewise constant case of Mumford and Shah (1989). The values of the
parts and the parts themselves are found in turns, the latter by graph cuts (Boykov, Veksler and
Zabih 2001).
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_count, check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._estimation.graph_cut import cheapest_side
from jaxdeform._mesh.laplacian import cotangent_weights, difference_matrix, lifted_weights
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.polygons import triangle_area_vectors

# What a border costs, as a length in mean edges. Over 108 fields of the bar in thirds of 0.05, 1
# and 20, blurred over up to two rows of vertices, with noise of up to 1 in log rigidity, so many
# vertices are in a wrong part: 4.3 % at 0.5, 3.1 at 1, 1.6 at 2, 0.8 at 4, and 8.1 at 8. At 2,
# spots of half the size are kept that vanish at 4. Halved where a part would be lost.
_LENGTHS = 2.0, 1.0, 0.5, 0.25
# Rounds of parts and values.
_ROUNDS = 20
# More parts than this no pose can tell apart.
_MOST = 64
# Values at which the first parts may be divided.
_DIVISIONS = 256
# Weights are kept within these multiples of the typical one.
_LEAST, _LARGEST = 1e-6, 1e6


def segment_rigidity(
    mesh: Mesh, field: ArrayLike, k: int, *, interval: ArrayLike | None = None
) -> Int[np.ndarray, "vertices"]:
    """Divide a mesh into k parts of nearly constant rigidity, given a field of rigidity.

    Minimises ``sum_i w_i (log field_i - c_part(i))^2 + cost * length of the borders`` over the
    parts and their values c. The weight w_i is the area of vertex i over the square of its
    interval's width, relative to the median: vertices of which the poses say nothing follow their
    neighbours. The cost is two mean edges times the square of the smallest difference between two
    c, so that spots narrower than a few edges belong to what is around them.

    A part may have several components: both soft ends of a bar with a stiff band are one part. How
    many parts there are, the poses say, not the field: fit them (`estimate_rigidity`) with one part
    more each time, until the fit is ``ok``.

    **Arguments**

    - mesh: the mesh of the field.
    - field: (vertices,) rigidity of each vertex, above 0: ``fit.field`` of
      `estimate_rigidity_field`.
    - k: number of parts, at most 64.
    - interval: (vertices, 2) interval of each: ``fit.interval``. Its ends may be 0 and infinity. By
      default all vertices are known equally well.

    **Returns** (vertices,) the part of each vertex, for ``estimate_rigidity(parts=)``: 0 is the
    softest, k - 1 the stiffest.

    **Raises** InputError: shapes that do not fit; a rigidity that is not above 0 and finite; an
    interval that is not a number, below 0, or whose ends are in the wrong order; no bounded
    interval; k not a whole number from 1 to 64; fewer than k different rigidities.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> band = jd.select.where(mesh, "y > 50 and y < 100")
        >>> parts = jd.segment_rigidity(mesh, 0.3 + 29.7 * band.mask, 2)
        >>> bool((parts == band.mask).all())
        True
    """
    check_type("mesh", mesh, Mesh)
    value = _check_field(field, mesh.n_vertices)
    check_count("k", k, most=min(_MOST, mesh.n_vertices))
    different = len(np.unique(value))
    if different < k:
        raise InputError(
            f"k is {k}, but the field has only {different} different rigidities: give k up to "
            f"{different}"
        )
    lengths, areas = _measure(mesh)
    weight = areas * _relative_weights(interval, mesh.n_vertices)
    parts = _divide(value, weight, k)
    for cost in _LENGTHS if k > 1 else ():
        refined = _refine(value, weight, parts, mesh.edges, cost * lengths)
        if len(np.unique(refined)) == k:
            parts = refined
            break
    mean = np.bincount(parts, weight * value) / np.bincount(parts, weight)
    return np.argsort(np.argsort(mean)).astype(np.int32)[parts]


# ---------------------------------------------------------------- what is given


def _check_field(field: ArrayLike, n: int) -> Float[np.ndarray, "vertices"]:
    """Return the logarithm of the field, or raise InputError."""
    given = read_host_array(field, np.float64, "field")
    if given.shape != (n,):
        raise InputError(f"field has shape {given.shape}: give one rigidity per vertex, ({n},)")
    bad = np.flatnonzero(~((given > 0) & np.isfinite(given)))
    if bad.size:
        raise InputError(
            f"field is {given[bad[0]]} at vertex {bad[0]}: it must be finite and above 0, because "
            "parts are found by its logarithm"
        )
    return np.log(given)


def _relative_weights(interval: ArrayLike | None, n: int) -> Float[np.ndarray, "vertices"]:
    """Return the weight of each vertex relative to the typical one, or raise InputError."""
    if interval is None:
        return np.ones(n)
    given = read_host_array(interval, np.float64, "interval")
    if given.shape != (n, 2):
        raise InputError(
            f"interval has shape {given.shape}: give the lower and the upper end of each vertex, "
            f"({n}, 2)"
        )
    low, high = given.T
    bad = np.flatnonzero(~((low >= 0) & (low <= high)))
    if bad.size:
        raise InputError(
            f"the interval of vertex {bad[0]} is {low[bad[0]]} to {high[bad[0]]}: give 0 or more, "
            "the lower end first"
        )
    open_ = (low == 0) | np.isinf(high)
    if open_.all():
        raise InputError(
            "the interval of every vertex is open, so the poses say nothing of this field: give "
            "more poses, or leave the interval out"
        )
    width = np.full(n, np.inf)
    width[~open_] = np.log(high[~open_]) - np.log(low[~open_])
    typical = max(float(np.median(width[~open_])), 1e-300)
    ratio = typical / np.maximum(width, 1e-3 * typical)
    return np.clip(ratio**2, _LEAST, _LARGEST)


def _measure(mesh: Mesh) -> tuple[Float[np.ndarray, "edges"], Float[np.ndarray, "vertices"]]:
    """Return how long a border is across each edge, and the area around each vertex.

    In mean edges and their squares. Across an edge runs its dual, cotangent weight times as long.
    """
    i, j = mesh.edges.T
    points = mesh.vertices / mesh.diagonal
    long = np.linalg.norm(points[i] - points[j], axis=1)
    area = triangle_area_vectors(points / long.mean(), mesh.solid_faces)
    third = np.linalg.norm(area, axis=1) / 3.0
    areas = np.bincount(mesh.solid_faces.ravel(), np.repeat(third, 3), mesh.n_vertices)
    # A vertex without area must belong to a part too.
    areas = np.maximum(areas, _LEAST * areas.mean())
    return lifted_weights(cotangent_weights(mesh)) * long / long.mean(), areas


# ---------------------------------------------------------------- parts by value alone


def _divide(value, weight, k: int) -> Int[np.ndarray, "vertices"]:
    """Return the parts with the least weighted variance of log rigidity, whatever the mesh.

    Sorted values, divided by dynamic programming (Fisher 1958).
    """
    levels, level = np.unique(value, return_inverse=True)
    ends = np.arange(len(levels) + 1)
    if len(levels) > 2 * _DIVISIONS:
        evenly = np.linspace(0, len(levels), _DIVISIONS + 1).astype(int)
        by_value = np.searchsorted(levels, np.linspace(levels[0], levels[-1], _DIVISIONS))
        ends = np.union1d(evenly, by_value)
    sums = [np.bincount(level, weight * value**power) for power in range(3)]
    mass, first, second = (np.concatenate([[0.0], np.cumsum(x)])[ends] for x in sums)
    variance = lambda a, b: (  # noqa: E731
        second[b] - second[a] - (first[b] - first[a]) ** 2 / (mass[b] - mass[a])
    )
    count = len(ends)
    least = np.concatenate([[0.0], variance(0, np.arange(1, count))])
    best = np.zeros((k, count), int)
    for part in range(1, k):
        before, least = least, np.full(count, np.inf)
        for b in range(part + 1, count):
            cost = before[part:b] + variance(np.arange(part, b), b)
            best[part, b] = part + np.argmin(cost)
            least[b] = cost.min()
    divisions, b = [], count - 1
    for part in range(k - 1, 0, -1):
        b = best[part, b]
        divisions.append(ends[b])
    return np.searchsorted(np.sort(divisions), level, side="right")


# ---------------------------------------------------------------- parts by value and border


class _Borders(NamedTuple):
    """What parts cost: of each vertex in each part, and of each edge between two parts."""

    cost: Float[np.ndarray, "vertices parts"]
    edges: Int[np.ndarray, "edges 2"]
    price: Float[np.ndarray, "edges"]

    def total(self, parts, at: Int[np.ndarray, "chosen"] | slice = slice(None)) -> float:
        """Return what these parts cost: the vertices ``at``, and all edges."""
        i, j = self.edges.T
        inside = np.take_along_axis(self.cost[at], parts[at, None], axis=1).sum()
        return float(inside + self.price[parts[i] != parts[j]].sum())

    def exchanged(self, parts, a: int, b: int):
        """Return the parts after the best exchange of vertices between a and b."""
        at = np.flatnonzero((parts == a) | (parts == b))
        place = np.full(len(parts), -1)
        place[at] = np.arange(len(at))
        inner = (place[self.edges] >= 0).all(axis=1)
        if not inner.any():
            return parts
        gain = self.cost[at, a] - self.cost[at, b]
        changed = parts.copy()
        to_b = cheapest_side(gain, place[self.edges[inner]], self.price[inner])
        changed[at] = np.where(to_b, b, a)
        return changed if self.total(changed) < self.total(parts) else parts

    def without_seams(self, parts):
        """Return the parts after components were given to their neighbours, where that is cheaper.

        Between a soft and a stiff part, a blurred field passes through all that lies between. No
        exchange of two parts removes such a seam, half of which belongs to either side.
        """
        n, parts = len(parts), parts.copy()
        i, j = self.edges.T
        same = parts[i] == parts[j]
        graph = sp.csr_matrix((np.ones(same.sum()), (i[same], j[same])), shape=(n, n))
        count, component = sp.csgraph.connected_components(graph, directed=False)
        members = np.split(np.argsort(component, kind="stable"), np.bincount(component).cumsum())
        touching = abs(difference_matrix(self.edges, n)).T.tocsr()
        for inside in sorted(members[:count], key=len):
            near = np.unique(touching[inside].indices)
            local = _Borders(self.cost, self.edges[near], self.price[near])
            around = np.setdiff1d(parts[local.edges], parts[inside])
            if around.size:
                old, before = parts[inside], local.total(parts, inside)
                parts[inside] = around[np.argmin(self.cost[inside][:, around], axis=1)]
                if local.total(parts, inside) >= before:
                    parts[inside] = old
        return parts


def _refine(value, weight, parts, edges, lengths) -> Int[np.ndarray, "vertices"]:
    """Return parts and values found in turns, until they stay. A part may vanish."""
    k = int(parts.max()) + 1
    for _ in range(_ROUNDS):
        before = parts
        mass = np.bincount(parts, weight, k)
        if not mass.all():
            break
        center = np.bincount(parts, weight * value, k) / mass
        cost = weight[:, None] * (value[:, None] - center) ** 2
        borders = _Borders(cost, edges, np.diff(np.sort(center)).min() ** 2 * lengths)
        for a in range(k):
            for b in range(a + 1, k):
                parts = borders.exchanged(parts, a, b)
        if k > 2:
            parts = borders.without_seams(parts)
        if (parts == before).all():
            break
    return parts
