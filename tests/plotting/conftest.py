"""Poses of the bar, and the pixels of pictures of them."""

import numpy as np
import pytest
from PIL import Image
from pixels import WIDTH

import jaxdeform as jd


@pytest.fixture
def bent(bar):
    return np.asarray(jd.bend(bar.vertices, 60.0))


@pytest.fixture
def exploded(bent):
    out = bent.copy()
    out[::7] *= 1e6
    return out


@pytest.fixture
def drawn(bar, tmp_path):
    """Return the pixels of a picture of poses of the bar."""

    def draw(poses, **options) -> np.ndarray:
        path = tmp_path / "drawn.png"
        jd.render(path, bar, poses, **{"width": WIDTH, **options})
        return np.asarray(Image.open(path), int)

    return draw
