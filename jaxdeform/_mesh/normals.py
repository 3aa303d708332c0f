"""Normals at vertices: the mean of those of their faces, seen from one side.

On a Moebius band the faces cannot all agree on a side, and in many files some do not. Where two
that meet are seen from opposite sides, their normals cancel, and rounding would be left. But around
one vertex there is always a choice.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._mesh.grouping import distinct, summed
from jaxdeform._mesh.mesh import connected_components
from jaxdeform._mesh.polygons import Polygons, area_vectors, unit


def corner_sides(polygons: Polygons) -> Int[np.ndarray, "corners"] | None:
    """Return 1, or -1 where the face is turned over as seen from most faces of its fan.

    None stands for 1 everywhere. A fan is a set of faces at a vertex, joined by edges with two
    faces. It is a part of a disc, so it has two sides. Each of the fans at a vertex has its own.
    """
    sizes, corners = polygons
    starts = polygons.starts
    corner = np.arange(len(corners))
    after = corner + 1
    after[starts + sizes - 1] = starts
    ends = corners, corners[after]
    count = int(corners.max(initial=-1)) + 1
    if len(distinct(ends[0] * count + ends[1])) == len(corners):
        return None  # no two faces run along an edge in the same direction
    low, high = np.minimum(*ends), np.maximum(*ends)
    order = np.lexsort((high, low))
    edge = (low * count + high)[order]
    _, first, faces = np.unique(edge, return_index=True, return_counts=True)
    one, two = (order[first[faces == 2] + k] for k in range(2))
    clash = ends[0][one] == ends[0][two]
    # At both ends of the edge, a corner of one face meets a corner of the other.
    here = np.concatenate([one, after[one]])
    there = np.concatenate([np.where(clash, two, after[two]), np.where(clash, after[two], two)])
    clash = np.tile(clash, 2)
    # Each corner stands twice: as it is, and turned over.
    size = len(corners)
    links = [(here, there + size * clash), (here + size, there + size * ~clash)]
    label = connected_components(np.concatenate([np.stack(x, 1) for x in links]), 2 * size)
    fan = connected_components(np.stack([here, there], axis=1), size)
    _, leader = np.unique(fan, return_index=True)
    sides = np.where(label[:size] == label[leader[fan]], 1, -1)
    return np.where(np.bincount(fan, sides) < 0, -1, 1)[fan] * sides


def vertex_normals(
    points: Float[np.ndarray, "points 3"], polygons: Polygons
) -> Float[np.ndarray, "points 3"]:
    """Return unit normals: of all polygons at a vertex, weighted by their areas."""
    vectors = corner_vectors(points, polygons)
    sides = corner_sides(polygons)
    if sides is not None:
        vectors *= sides[:, None]
    return unit(summed(vectors, polygons.corners, len(points)))


def corner_vectors(
    points: Float[np.ndarray, "points 3"], polygons: Polygons
) -> Float[np.ndarray, "corners 3"]:
    """Return the area vector of the polygon of each corner."""
    return np.repeat(area_vectors(points, polygons), polygons.sizes, axis=0)
