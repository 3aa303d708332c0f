"""Vertices that were seen in a wrong place: far from what their neighbours say."""

import numpy as np
from jaxtyping import Bool, Float, Int

# Of the robust standard deviation (from the median of absolute deviations).
_FAR = 6.0
# More than this fraction of the vertices are no outliers: then the model is wrong, or the noise.
MANY = 0.1
# As many neighbours are asked, and at least so many must have been seen.
_ASKED, _FEWEST = 12, 3


def find_outliers(
    edges: Int[np.ndarray, "edges 2"],
    residual: Float[np.ndarray, "poses vertices 3"],
    counted: Bool[np.ndarray, "poses vertices"],
    floor: float,
) -> Bool[np.ndarray, "poses vertices"]:
    """Return the vertices whose residual lies far from the median of their neighbours' residuals.

    Smooth errors of the model move neighbours alike and are kept. Deviations under ``floor`` (a
    length) are none.
    """
    neighbours = _neighbours(edges, counted.shape[1])
    found = np.zeros(counted.shape, bool)
    for pose, mask in enumerate(counted):
        asked = np.append(residual[pose], [[np.nan] * 3], axis=0)
        asked[:-1][~mask] = np.nan
        around = asked[neighbours]
        enough = mask & (np.isfinite(around[..., 0]).sum(axis=1) >= _FEWEST)
        if not enough.any():
            continue
        off = np.abs(residual[pose, enough] - np.nanmedian(around[enough], axis=1))
        deviation = 1.4826 * np.median(off)
        found[pose, enough] = (off > max(_FAR * deviation, floor)).any(axis=1)
    return found


def _neighbours(edges, n: int) -> Int[np.ndarray, "vertices asked"]:
    """Return some neighbours of each vertex; n stands for none."""
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    place = np.arange(len(both)) - np.searchsorted(both[:, 0], both[:, 0])
    table = np.full((n, _ASKED), n)
    few = place < _ASKED
    table[both[few, 0], place[few]] = both[few, 1]
    return table
