"""Polygons: kept as a file gives them, cut into triangles for the work."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxdeform._mesh.ears import cut_ears

# Up to this size, all ways to cut a polygon are compared: n^3 / 6 triangles. Above, ears are cut.
_ALL_WAYS = 32

# Numbers at work at once when many polygons are cut together: 16 MB.
_AT_ONCE = 1 << 21


class Polygons(NamedTuple):
    """Faces with any number of corners."""

    sizes: Int[np.ndarray, "polygons"]
    """The number of corners of each polygon, at least three."""
    corners: Int[np.ndarray, "corners"]
    """Vertex indices of all polygons, one after another."""

    @property
    def starts(self) -> Int[np.ndarray, "polygons"]:
        """Where the corners of each polygon begin."""
        return np.cumsum(self.sizes) - self.sizes

    def same(self, other: "Polygons") -> bool:
        """Return whether the others have the same corners in the same order."""
        return all(map(np.array_equal, self, other))


def from_triangles(faces: Int[np.ndarray, "faces 3"]) -> Polygons:
    """Return triangles as polygons."""
    return Polygons(np.full(len(faces), 3), faces.reshape(-1))


def from_lists(sizes: list[int], corners: list[int]) -> Polygons:
    """Return polygons from lists, or raise OverflowError: an index has more than 64 bits."""
    return Polygons(np.array(sizes, np.int64), np.array(corners, np.int64))


def triangles(points: Float[np.ndarray, "points 3"], polygons: Polygons) -> np.ndarray:
    """Return (triangles, 3): each polygon cut into triangles between its own corners.

    All corners are used, also where three lie on a line, because neighbours share them. Among the
    ways to cut that turn every triangle to the polygon's own side, the one with the shortest
    diagonals is taken. Such triangles neither overlap nor leave the polygon: together they cover
    what its border winds around, once. The side is told in the plane across the mean normal
    (Newell), so that a polygon that is not planar is cut as its shadow there. A quad is cut along
    its shorter diagonal, unless that runs outside.
    """
    sizes, corners = polygons
    first = np.cumsum(sizes - 2) - (sizes - 2)
    out = np.empty((int((sizes - 2).sum()), 3), np.int64)
    starts = polygons.starts
    inside = (corners >= 0) & (corners < len(points))
    whole = np.logical_and.reduceat(inside, starts) if len(sizes) else np.empty(0, bool)
    for size in np.unique(sizes).tolist():
        same = np.flatnonzero(sizes == size)
        table = corners[starts[same, None] + np.arange(size)]
        # The fan of polygons that name missing vertices: the mesh's own checks tell of them.
        local = np.tile(_fan(size), (len(same), 1, 1))
        good = whole[same] & (size > 3)
        if size > _ALL_WAYS:
            # Triangles that do not overlap are at most 2 d - 5, at d different vertices. A polygon
            # with more corners than that overlaps itself, and would keep the search for ears long.
            different = 1 + (np.diff(np.sort(table, axis=1), axis=1) > 0).sum(axis=1)
            good &= size - 2 <= 2 * different - 5
        if good.any():
            local[good] = _cut(points, table[good])
        rows = first[same, None] + np.arange(size - 2)
        out[rows] = np.take_along_axis(table[:, None], local, axis=2)
    return out


def _fan(size: int) -> Int[np.ndarray, "triangles 3"]:
    k = np.arange(1, size - 1)
    return np.stack([np.zeros_like(k), k, k + 1], axis=1)


def _cut(
    points: Float[np.ndarray, "points 3"], table: Int[np.ndarray, "polygons n"]
) -> Int[np.ndarray, "polygons triangles 3"]:
    """Return how to cut polygons of one size, by the numbers of their corners."""
    m, n = table.shape
    step = max(1, _AT_ONCE // n**2)
    out = np.empty((m, n - 2, 3), np.int64)
    for begin in range(0, m, step):
        part = slice(begin, begin + step)
        with np.errstate(invalid="ignore"):  # who reads refuses what is not finite
            # Halved, and scaled before products are taken: no number leaves the range of float64.
            corner = points[table[part]] / 2
            corner -= corner[:, :1].copy()
            scale = np.abs(corner).max(axis=(1, 2), keepdims=True)
            corner = corner / np.where(scale > 0, scale, 1.0)
            flat = _flattened(corner)
            cut = _best(corner, flat) if n <= _ALL_WAYS else [cut_ears(shape) for shape in flat]
        out[part] = cut
    return out


def _flattened(corner: Float[np.ndarray, "polygons n 3"]) -> Float[np.ndarray, "polygons n 2"]:
    """Return the shadows of polygons in the planes across their mean normals."""
    normal = np.cross(corner, np.roll(corner, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    aside = np.eye(3)[np.abs(normal).argmin(axis=1)]
    u = np.cross(aside, normal)
    u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
    axes = np.stack([u, np.cross(normal, u)], axis=2)
    return corner @ axes


def _best(
    corner: Float[np.ndarray, "polygons n 3"], flat: Float[np.ndarray, "polygons n 2"]
) -> Int[np.ndarray, "polygons triangles 3"]:
    """Compare all ways to cut, by the method of dynamic programming (Klincsek 1980)."""
    m, n = flat.shape[:2]
    length = np.linalg.norm(corner[:, :, None] - corner[:, None], axis=3)
    cost = np.zeros((m, n, n))
    apex = np.zeros((m, n, n), np.int64)
    for gap in range(2, n):
        i = np.arange(n - gap)[:, None]
        j = i + gap
        # Of equal diagonals, the one at the first corner, as a fan has it.
        k = (i + np.arange(gap - 1, 0, -1))[None]
        each = cost[:, i, k[0]] + cost[:, k[0], j] + 1e-6 * (j - k)
        each += n * _turned_over(flat, length, i, k[0], j)
        choice = each.argmin(axis=2)
        apex[:, i[:, 0], j[:, 0]] = j[:, 0] - 1 - choice
        cost[:, i[:, 0], j[:, 0]] = each.min(axis=2) + length[:, i[:, 0], j[:, 0]] / 4
    return _collected(apex)


def _turned_over(flat, length, i, k, j) -> Bool[np.ndarray, "polygons rows choices"]:
    """Return whether the triangle i, k, j has no area or lies on the wrong side."""
    a, b, c = (flat[:, index] for index in (i, k, j))
    u, v = b - a, c - a
    area = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    longest = np.maximum(np.maximum(length[:, i, k], length[:, k, j]), length[:, i, j])
    return area <= 1e-10 * longest**2


def _collected(apex: Int[np.ndarray, "polygons n n"]) -> Int[np.ndarray, "polygons triangles 3"]:
    """Return the triangles below the edge from the first corner to the last, in order."""
    m, n = apex.shape[:2]
    which, i, j = np.arange(m), np.zeros(m, np.int64), np.full(m, n - 1)
    found = []
    while len(which):
        k = apex[which, i, j]
        found.append(np.stack([which, i, k, j], axis=1))
        which, i, j = (np.concatenate(pair) for pair in ((which, which), (i, k), (k, j)))
        open_ = j - i > 1
        which, i, j = which[open_], i[open_], j[open_]
    rows = np.concatenate(found)
    order = np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))
    return rows[order, 1:].reshape(m, n - 2, 3)


def area_vectors(
    points: Float[np.ndarray, "points 3"], polygons: Polygons
) -> Float[np.ndarray, "polygons 3"]:
    """Return the mean normal of each polygon (Newell); the lengths are in proportion to areas.

    Points of a file may be of any size. Of a mesh, see `triangle_area_vectors`.
    """
    sizes, corners = polygons
    starts = polygons.starts
    following = np.arange(1, len(corners) + 1)
    following[starts + sizes - 1] = starts
    corner = points[corners] / 2
    corner -= np.repeat(corner[starts], sizes, axis=0)
    corner /= np.abs(corner).max() or 1.0
    return np.add.reduceat(np.cross(corner, corner[following]), starts, axis=0)


def triangle_area_vectors(
    points: Float[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 3"]:
    """Return the normal of each triangle, as long as its area. What is not finite stays in its own.

    The points are those of a mesh, or of a pose of it: their squares are in the range of float64.
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def unit(vectors: Float[np.ndarray, "rows 3"]) -> Float[np.ndarray, "rows 3"]:
    """Return the vectors with length one; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
