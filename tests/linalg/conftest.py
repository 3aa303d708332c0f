"""What tests of the linear algebra share."""

import numpy as np
import pytest


@pytest.fixture
def right():
    return np.random.default_rng(2).normal(size=(2, 3, 1500))
