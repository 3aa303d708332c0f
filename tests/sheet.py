"""A mesh small enough for loops, dense matrices and SciPy's slow but sure solvers."""

import numpy as np

import jaxdeform as jd


def bumpy_sheet() -> jd.Mesh:
    """Return an open sheet of 8 x 7 vertices with hills, in no direction symmetric."""
    x, y = np.meshgrid(np.arange(8.0), np.arange(7.0))
    z = 0.6 * np.sin(1.3 * x) * np.cos(0.9 * y)
    low = (np.arange(7)[None] + 8 * np.arange(6)[:, None]).ravel()
    faces = [np.stack([low, low + 1, low + 9], 1), np.stack([low, low + 9, low + 8], 1)]
    return jd.Mesh(np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate(faces))
