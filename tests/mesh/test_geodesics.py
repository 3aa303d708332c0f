"""Distances along a surface, against straight lines and unfoldings."""

import numpy as np
from helpers import CUBE

import jaxdeform as jd


def test_geodesic_distances():
    """On a flat sheet they are straight; around a box they follow its unfolding."""
    square = jd.shapes.square()
    flat = jd.geodesic_distances(square, [0, 4])
    straight = np.linalg.norm(square.vertices[:, None] - square.vertices[[0, 4]], axis=2)
    np.testing.assert_allclose(flat, straight, atol=1e-7)
    around = jd.geodesic_distances(CUBE, [0])[7, 0]
    np.testing.assert_allclose(around, np.sqrt(2.0**2 + 4.0**2), rtol=1e-7)
    two = jd.Mesh(
        np.concatenate([square.vertices, square.vertices + 9, [[5, 5, 5]]]),
        np.concatenate([square.faces, square.faces + 9]),
    )
    apart = jd.geodesic_distances(two, [4, 18])
    np.testing.assert_allclose(apart[:9, 0], flat[:, 1], atol=1e-7)
    assert np.isinf(apart[9:, 0]).all()
    assert apart[18, 1] == 0
