"""Look at pixels."""

import numpy as np

from jaxdeform._plotting.color import rgb

WIDTH = 120


def close_to(image, color: str, within: int = 30) -> np.ndarray:
    return (np.abs(image - 255 * rgb(color)).max(axis=2) < within).nonzero()[0]


def ink(image) -> np.ndarray:
    return (image != 255).any(axis=2)


def panels(image: np.ndarray, count: int) -> list[np.ndarray]:
    return [image[:, k * WIDTH : (k + 1) * WIDTH] for k in range(count)]
