"""Ear cutting, for polygons with many corners."""

from collections import deque
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float, Int

# Corners on a line, but for rounding, and corners in one place; the polygon is about 1 wide.
_FLAT, _SAME = 1e-10, 1e-13


def cut_ears(flat: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "triangles 3"]:
    """Return triangles (n - 2, 3) by the numbers of the corners.

    An ear is a corner whose triangle with its neighbours has an area and contains no other corner,
    also none on its border. Every simple polygon has two (Meisters 1975). What is left of one that
    crosses itself and has no ear is cut as a fan.

    A cut changes whether its two neighbours are ears; others are asked again only when no candidate
    is left, a few times at most. So n corners take at most a few n tests, each of n numbers.
    """
    n = len(flat)
    # Corners as complex numbers: Python is faster than NumPy with one of them at a time.
    points = flat @ np.array([1, 1j])
    corner: list[complex] = points.tolist()
    before, after = [n - 1, *range(n - 1)], [*range(1, n), 0]
    here = np.ones(n, bool)
    outward = np.array([_outward(corner[k - 1], corner[k], corner[after[k]]) for k in range(n)])
    out: list[tuple[int, int, int]] = []
    for _ in range(8):
        # Every second corner first, or one corner would collect long thin triangles.
        left = np.flatnonzero(here)
        waiting = deque(np.concatenate([left[::2], left[1::2]]).tolist())
        cut_before = len(out)
        while waiting and len(out) < n - 3:
            b = waiting.popleft()
            a, c = before[b], after[b]
            if not (here[b] and outward[b]):
                continue
            if _covers(corner[a], corner[b], corner[c], points, here & ~outward):
                continue
            out.append((a, b, c))
            here[b] = False
            after[a], before[c] = c, a
            for k in (a, c):
                outward[k] = _outward(corner[before[k]], corner[k], corner[after[k]])
                waiting.append(k)
        if len(out) in (cut_before, n - 3):
            break
    left = np.flatnonzero(here)
    out += [(int(left[0]), int(b), int(c)) for b, c in pairwise(left[1:])]
    return np.array(out)


def _outward(a: complex, b: complex, c: complex) -> bool:
    """Return whether the corner b turns to the polygon's side, by more than rounding."""
    return _area(a, b, c) > _FLAT * _longest(a, b, c) ** 2


def _area(a: complex, b: complex, c: Any) -> Any:
    """Return twice the signed area of triangles; c may be an array."""
    return ((b - a).conjugate() * (c - a)).imag


def _longest(a: complex, b: complex, c: complex) -> float:
    return max(abs(b - a), abs(c - b), abs(a - c))


def _covers(a: complex, b: complex, c: complex, points: np.ndarray, asked: np.ndarray) -> bool:
    """Return whether the triangle has one of the points asked for in it or on its border."""
    low = complex(min(a.real, b.real, c.real), min(a.imag, b.imag, c.imag))
    high = complex(max(a.real, b.real, c.real), max(a.imag, b.imag, c.imag))
    longest = _longest(a, b, c)
    # Most lie outside its box.
    margin = _FLAT * longest
    x, y = np.real(points), np.imag(points)
    near = asked & (x >= low.real - margin) & (x <= high.real + margin)
    near &= (y >= low.imag - margin) & (y <= high.imag + margin)
    inside = points[near]
    for u, v in ((a, b), (b, c), (c, a)):
        if not len(inside):
            return False
        inside = inside[_area(u, v, inside) >= -_FLAT * longest**2]
    # A border that runs back to itself, as around a hole, has corners in the same place.
    for end in (a, b, c):
        inside = inside[np.abs(inside - end) > _SAME]
    return len(inside) > 0
