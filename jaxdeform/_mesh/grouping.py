"""Distinct values, and sums of the rows that belong together."""

import numpy as np
from jaxtyping import Float, Int


def distinct(values: Int[np.ndarray, "values"]) -> Int[np.ndarray, "distinct"]:
    """Return the distinct values in ascending order, as np.unique does.

    np.unique of NumPy 2.4 hashes them: 3.9 s for three million, and 0.2 s by sorting.
    """
    ascending = np.sort(values)
    return ascending[np.diff(ascending, prepend=ascending[:1] - 1) != 0]


def summed(
    rows: Float[np.ndarray, "rows columns"], where: Int[np.ndarray, "rows"], count: int
) -> Float[np.ndarray, "count columns"]:
    """Return the sums of the rows that belong together."""
    return np.stack([np.bincount(where, column, count) for column in rows.T], axis=1)
