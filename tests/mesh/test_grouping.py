"""Values and rows that belong together."""

import numpy as np

from jaxdeform._mesh.grouping import distinct


def test_distinct_is_what_numpy_finds():
    for size in (0, 1, 5, 1000):
        values = np.random.default_rng(size).integers(-300, 300, size)
        np.testing.assert_array_equal(distinct(values), np.unique(values))
