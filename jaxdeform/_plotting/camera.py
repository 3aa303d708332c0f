"""Where to look from: which way is up, from which side, and how large."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.polygons import triangle_area_vectors

# A foot is what lies this close to the ground, as a fraction of the bounding box's diagonal.
_NEAR = 0.02
# Around what is drawn, as a fraction of its size.
_MARGIN = 0.05


def guess_up(mesh: Mesh) -> Float[np.ndarray, "3"]:
    """Return the axis, with its sign, along which the mesh seems to stand.

    It stands on a foot: the vertices near the ground span much of its outline, with the middle of
    the surface above them, and far more than those near the top do. Without one the longest axis is
    up; among nearly equal ones y, then z.
    """
    points = mesh.vertices[mesh.referenced]
    corners = mesh.vertices[mesh.solid_faces]
    area = np.linalg.norm(triangle_area_vectors(mesh.vertices, mesh.solid_faces), axis=1)
    middle = (corners.mean(axis=1) * area[:, None]).sum(axis=0) / area.sum()
    best, up = 0.0, None
    for axis in range(3):
        level = np.delete(np.arange(3), axis)
        outline = _hull_area(points[:, level], None)
        if outline == 0:
            continue
        feet = []
        for sign in (1, -1):
            height = sign * points[:, axis]
            near = height < height.min() + _NEAR * mesh.diagonal
            feet.append(_hull_area(points[near][:, level], middle[level]) / outline)
        share, sign = max((feet[0], 1), (feet[1], -1))
        if share > 0.25 and share > 2.5 * min(feet) and share > best:
            best, up = share, sign * np.eye(3)[axis]
    if up is not None:
        return up
    extent = np.ptp(points, axis=0)
    long = [axis for axis in (1, 2, 0) if extent[axis] > 0.8 * extent.max()]
    return np.eye(3)[long[0]]


def _hull_area(points: Float[np.ndarray, "points 2"], inside: np.ndarray | None) -> float:
    """Return the area of the convex hull, or 0 if this point is not inside."""
    try:
        hull = scipy.spatial.ConvexHull(points)
    except (scipy.spatial.QhullError, ValueError):  # fewer than three points, or all on a line
        return 0.0
    if inside is not None and (hull.equations @ np.append(inside, 1.0) > 0).any():
        return 0.0
    return float(hull.volume)


class View(NamedTuple):
    """A parallel view: three directions, and the rectangle that it shows."""

    right: Float[np.ndarray, "3"]
    above: Float[np.ndarray, "3"]
    toward: Float[np.ndarray, "3"]
    """From the middle of the mesh to the eye."""
    focus: Float[np.ndarray, "3"]
    half_width: float
    half_height: float
    depth: float
    """The diagonal of what is shown."""


def find_view(
    poses: list[Float[np.ndarray, "_ 3"]], up: np.ndarray, turns: np.ndarray
) -> list[View]:
    """Return a view for each turn (in radians) about the up axis, all of the same rectangle.

    The poses fill it. It looks along the level direction in which all of them together are
    thinnest, from a little to the side and above.
    """
    points = np.concatenate(poses)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = low + (high - low) / 2
    front, side = _level_axes(points, up)
    views = []
    for turn in turns:
        ahead = np.cos(turn) * front + np.sin(turn) * side
        aside = np.cos(turn) * side - np.sin(turn) * front
        toward = ahead + 0.42 * aside + 0.32 * up
        toward /= np.linalg.norm(toward)
        right = np.cross(up, toward)
        right /= np.linalg.norm(right)
        views.append((right, np.cross(toward, right), toward))
    away = points - middle
    spans = [(away @ axes[k]) for axes in views for k in (0, 1)]
    lows, highs = np.array([s.min() for s in spans]), np.array([s.max() for s in spans])
    # Around an axis the rectangle must not wander, so all views share it.
    u = (lows[0::2].min(), highs[0::2].max())
    v = (lows[1::2].min(), highs[1::2].max())
    largest = float((high - low).max()) or 1.0
    depth = largest * float(np.linalg.norm((high - low) / largest)) or 1.0
    margin = _MARGIN * max(u[1] - u[0], v[1] - v[0])
    half = [max((b - a) / 2, 0.05 * depth) + margin for a, b in (u, v)]
    return [
        View(
            right,
            above,
            toward,
            middle + right * (u[0] + u[1]) / 2 + above * (v[0] + v[1]) / 2,
            float(half[0]),
            float(half[1]),
            depth,
        )
        for right, above, toward in views
    ]


def _level_axes(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level direction to look from, and the one to its right."""
    # What files show from the front: y up looks along z, z up (as in Blender) along -y.
    axes = [np.eye(3)[2], -np.eye(3)[1], np.eye(3)[0]]
    flat = [axis - (axis @ up) * up for axis in axes]
    steepest = int(np.argmin([np.linalg.norm(axis) for axis in flat]))
    first = flat[1 if steepest == 0 else 0]
    first = first / np.linalg.norm(first)
    second = np.cross(up, first)
    if np.ptp(points @ second) < 0.8 * np.ptp(points @ first):
        first = second
    return first, np.cross(up, first)
