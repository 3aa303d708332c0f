"""Distances along a surface, against straight lines and unfoldings."""

import numpy as np
import pytest
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


@pytest.mark.parametrize("height", [1e-6, 1e-9])
@pytest.mark.parametrize("size", [1e-20, 1.0])
def test_faces_too_flat_are_named(height, size):
    """libigl does not end on some of them."""
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    tip = [[0.5, height, 0.0]]
    mesh = jd.Mesh(size * np.array(square + tip), [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    for call in (
        lambda: jd.geodesic_distances(mesh, [2]),
        lambda: jd.select.within(mesh, [2], 1.0 * size),
    ):
        with pytest.raises(jd.InputError, match=r"face \[0, 1, 4\] is too flat"):
            call()
