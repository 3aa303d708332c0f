"""Ear cutting, for polygons with many corners."""

from collections import deque
from itertools import pairwise

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
    before, after = np.arange(-1, n - 1) % n, np.arange(1, n + 1) % n
    here = np.ones(n, bool)
    outward = _outward(flat[before], flat, flat[after])
    out: list[tuple[int, int, int]] = []
    for _ in range(8):
        # Every second corner first, or one corner would collect long thin triangles.
        left = np.flatnonzero(here)
        waiting = deque(np.concatenate([left[::2], left[1::2]]).tolist())
        cut_before = len(out)
        while waiting and len(out) < n - 3:
            b = waiting.popleft()
            a, c = int(before[b]), int(after[b])
            if not here[b] or not _is_ear(flat, flat[here & ~outward], a, b, c):
                continue
            out.append((a, b, c))
            here[b] = False
            after[a], before[c] = c, a
            for corner in (a, c):
                ends = flat[before[corner]], flat[corner], flat[after[corner]]
                outward[corner] = _outward(*ends)
                waiting.append(corner)
        if len(out) in (cut_before, n - 3):
            break
    left = np.flatnonzero(here)
    out += [(int(left[0]), int(b), int(c)) for b, c in pairwise(left[1:])]
    return np.array(out)


def _outward(a, b, c):
    """Return whether the corners b turn to the polygon's side, by more than rounding."""
    return _area(a, b, c) > _FLAT * _longest(a, b, c) ** 2


def _area(a, b, c):
    """Return twice the signed area of triangles."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _longest(a, b, c):
    return np.maximum(np.maximum(abs(b - a), abs(c - b)), abs(a - c)).max(axis=-1)


def _is_ear(flat: np.ndarray, others: np.ndarray, a: int, b: int, c: int) -> bool:
    """Return whether the triangle has an area and none of the others in it or on its border."""
    p, q, r = flat[a], flat[b], flat[c]
    if not _outward(p, q, r):
        return False
    slack = -_FLAT * _longest(p, q, r) ** 2
    inside = _area(p, q, others) >= slack
    inside &= _area(q, r, others) >= slack
    inside &= _area(r, p, others) >= slack
    # A border that runs back to itself, as around a hole, has corners in the same place.
    for corner in (p, q, r):
        inside &= np.abs(others - corner).max(axis=1) > _SAME
    return not inside.any()
