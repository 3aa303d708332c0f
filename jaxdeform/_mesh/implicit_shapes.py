"""Cactus and octopus: unions of round cones, polygonised by marching cubes and remeshed.

A limb is a path with a radius at each point, so a chain of round cones: the points within r(s) of
the segment at s. The solid is where the smooth minimum of their distances is below zero:

    f(x) = -(w / 2) log sum_i exp(-d_i(x) / (w / 2)),

with w the width over which neighbouring limbs blend.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._errors import InputError
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.polygons import triangle_area_vectors, unit

Points = Float[np.ndarray, "points 3"]
Faces = Int[np.ndarray, "faces 3"]
Path = tuple[Sequence[Sequence[float | int]], Sequence[float | int]]

# A grid cell's corners, in the order in which igl.marching_cubes reads them.
_CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)


class Cone(NamedTuple):
    """A round cone: a sphere of radius that goes from one end's to the other's."""

    a: Float[np.ndarray, "3"]
    b: Float[np.ndarray, "3"]
    radius_a: float
    radius_b: float

    def distance(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
        """Return about the signed distance, negative inside; exact where the radii are equal."""
        axis = self.b - self.a
        s = np.clip((points - self.a) @ axis / (axis @ axis), 0.0, 1.0)
        radius = self.radius_a + s * (self.radius_b - self.radius_a)
        return np.linalg.norm(points - self.a - s[..., None] * axis, axis=-1) - radius

    def box(self, margin: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the corners of an axis-aligned box around the cone."""
        reach = max(self.radius_a, self.radius_b) + margin
        return np.minimum(self.a, self.b) - reach, np.maximum(self.a, self.b) + reach


def cactus() -> Mesh:
    """Return a cactus-like shape of about 5,300 vertices: a trunk with two bent arms, along y.

    Example:
        >>> import jaxdeform as jd
        >>> 5000 < jd.shapes.cactus().n_vertices < 5600
        True
    """
    limbs = [
        ([[0, 0, 0], [0, 2.2, 0], [0, 4.4, 0]], [0.62, 0.58, 0.5]),
        ([[0, 1.5, 0], [1.0, 1.6, 0], [1.45, 2.1, 0], [1.5, 3.3, 0]], [0.3, 0.3, 0.32, 0.28]),
        (
            [[0, 2.2, 0], [-0.9, 2.3, 0], [-1.3, 2.8, 0.1], [-1.35, 3.7, 0.1]],
            [0.28, 0.28, 0.3, 0.26],
        ),
    ]
    return _smooth_union(limbs, 0.18, 5300)


def octopus(vertices: int = 50_000) -> Mesh:
    """Return an octopus-like shape: a head and eight curled tentacles, y upwards.

    **Arguments**: vertices, about how many it should have (within 5 %).
    **Raises** InputError below 5,000: the tentacles would break off.

    Example:
        >>> import jaxdeform as jd
        >>> 9_500 < jd.shapes.octopus(10_000).n_vertices < 10_500
        True
    """
    whole = isinstance(vertices, int | np.integer) or (
        isinstance(vertices, float) and vertices.is_integer()
    )
    if not whole or vertices < 5_000:
        raise InputError(f"octopus of {vertices} vertices: give a whole number, 5000 or more")
    limbs = [([[0, 0.4, 0], [0, 1.3, 0.1]], [0.72, 0.85])]
    for k in range(8):
        direction = 2 * np.pi * (k + 0.5) / 8
        s = np.linspace(0, 1, 14)
        out = 0.35 + 2.6 * s
        swing = direction + 0.5 * np.sin(2.4 * s)
        lift = -0.15 - 0.75 * np.sin(np.pi * 0.8 * s) + 0.9 * s**3
        path = np.stack([out * np.cos(swing), lift, out * np.sin(swing)], axis=1)
        limbs.append((path.tolist(), (0.27 - 0.18 * s).tolist()))
    return _smooth_union(limbs, 0.1, int(vertices))


def _smooth_union(limbs: Sequence[Path], width: float, n_vertices: int) -> Mesh:
    """Return the surface of the melted limbs, with about the given number of vertices."""
    cones = [
        Cone(np.array(a, float), np.array(b, float), ra, rb)
        for path, radii in limbs
        for (a, b), (ra, rb) in zip(pairwise(path), pairwise(radii), strict=True)
    ]
    spacing = 0.06
    for _ in range(4):
        points, faces = _polygonise(cones, width, spacing)
        points, faces = _collapse_short_edges(points, faces, 0.4 * spacing)
        ratio = len(points) / n_vertices
        if abs(ratio - 1) < 0.04:
            break
        spacing *= np.sqrt(ratio)
    points = _relax(points, faces, cones, width)
    a, b, c = (points[faces[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    return Mesh(points, faces if outward else faces[:, ::-1])


def _polygonise(cones: list[Cone], width: float, spacing: float) -> tuple[Points, Faces]:
    """Run marching cubes on the grid cells that the surface passes through, and on no others."""
    boxes = np.array([cone.box(2 * width) for cone in cones])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    field = _field_on_grid(axes, cones, width)
    # A value of zero at a corner would give several vertices in one place.
    field[field == 0] = 1e-9 * spacing
    inside = field < 0
    size = np.array(field.shape)
    count = sum(
        inside[tuple(slice(k, n - 1 + k) for k, n in zip(corner, size, strict=True))].astype(int)
        for corner in _CORNERS
    )
    cells = np.argwhere((count > 0) & (count < 8))
    corners = np.ravel_multi_index(np.moveaxis(cells[:, None] + _CORNERS, -1, 0), size)
    used, index = np.unique(corners, return_inverse=True)
    grid = low + spacing * np.stack(np.unravel_index(used, size), axis=1)
    points, faces = igl.marching_cubes(
        field.ravel()[used], np.ascontiguousarray(grid), index.reshape(-1, 8), 0.0
    )[:2]  # libigl before 2.6.3 returns no more
    return np.asarray(points), np.asarray(faces).astype(np.int64)


def _field_on_grid(axes, cones: list[Cone], width: float) -> Float[np.ndarray, "x y z"]:
    """Evaluate f on a grid, each cone only in its own neighbourhood."""
    total = np.zeros([len(axis) for axis in axes])
    for cone in cones:
        window = tuple(
            slice(*np.searchsorted(axis, ends))
            for axis, *ends in zip(axes, *cone.box(8 * width), strict=True)
        )
        near = [axis[w] for axis, w in zip(axes, window, strict=True)]
        points = np.stack(np.meshgrid(*near, indexing="ij"), axis=-1)
        total[window] += np.exp(-cone.distance(points) / (0.5 * width))
    return -0.5 * width * np.log(total + 1e-30)


def _field(points: Points, cones: list[Cone], width: float) -> Float[np.ndarray, "points"]:
    total = np.full(len(points), 1e-30)
    for cone in cones:
        low, high = cone.box(8 * width)
        near = ((points > low) & (points < high)).all(axis=1)
        total[near] += np.exp(-cone.distance(points[near]) / (0.5 * width))
    return -0.5 * width * np.log(total)


def _collapse_short_edges(
    points: Points, faces: Faces, shortest: float
) -> tuple[Float[np.ndarray, "kept_points 3"], Int[np.ndarray, "kept_faces 3"]]:
    """Merge vertices closer than ``shortest``: marching cubes leaves slivers at clipped corners.

    Each vertex takes part in one merge at most, and only where the two share exactly two
    neighbours, which keeps the surface closed and manifold.
    """
    for _ in range(8):
        n = len(points)
        # Each edge of a closed surface runs once in each direction.
        start, end = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
        neighbours = sp.csr_matrix((np.ones(len(start), bool), (start, end)), shape=(n, n))
        degree = np.diff(neighbours.indptr).tolist()
        start, end = start[start < end], end[start < end]
        length = np.linalg.norm(points[start] - points[end], axis=1)
        short = np.argsort(length, kind="stable")[: int((length < shortest).sum())]
        target = np.arange(n)
        frozen: set[int] = set()
        for i, j in zip(start[short].tolist(), end[short].tolist(), strict=True):
            of_i, of_j = (
                set(neighbours.indices[neighbours.indptr[k] : neighbours.indptr[k + 1]].tolist())
                for k in (i, j)
            )
            around, shared = of_i | of_j, of_i & of_j
            if around & frozen or len(shared) != 2 or any(degree[k] <= 4 for k in shared):
                continue
            frozen |= around
            points[i] = (points[i] + points[j]) / 2
            target[j] = i
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        used, flat = np.unique(faces, return_inverse=True)
        points, faces = points[used], flat.reshape(-1, 3)
        if len(points) == n:
            break
    return points, faces


def _relax(points: Points, faces: Faces, cones: list[Cone], width: float) -> Points:
    """Even out the triangles: move each vertex towards its neighbours, along the surface."""
    n = len(points)
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    adjacency = sp.coo_matrix((np.ones(ends.shape[1]), tuple(ends)), shape=(n, n)).tocsr()
    average = sp.diags(1 / np.asarray(adjacency.sum(axis=1)).ravel()) @ adjacency
    corner = (np.ones(faces.size), (faces.ravel(), np.repeat(np.arange(len(faces)), 3)))
    faces_of = sp.coo_matrix(corner, shape=(n, len(faces))).tocsr()
    for _ in range(12):
        normal = unit(faces_of @ triangle_area_vectors(points, faces))
        move = average @ points - points
        points = points + 0.5 * (move - (move * normal).sum(axis=1, keepdims=True) * normal)
        points = points - normal * _field(points, cones, width)[:, None]
    return points
