"""Smooth patterns over the vertices that are compared: where a model that is wrong shows.

Noise of a scan is independent from vertex to vertex. A material, a handle or a neighbourhood that
is not as the model has it moves whole regions. The leading eigenvectors of exp(-distance / length)
tell the two apart. They need no faces, so vertices that were not seen leave no holes to mind; those
of the mesh's Laplacian do worse (intervals cover in 71 % where these make them cover in 91 %).
"""

import numpy as np
from jaxtyping import Bool, Float

# Of the diagonal of the bounding box.
_LENGTH = 0.5
# Patterns; what they leave is one band of its own. Fewer vertices than four times the least number
# have no patterns: then all noise counts as independent.
_MOST, _FEWEST = 75, 8
# Of more vertices, the eigenvectors are those of a random sample, extended (Nystroem).
_SAMPLE = 300


def smooth_modes(
    points: Float[np.ndarray, "vertices 3"],
    counted: Bool[np.ndarray, "poses vertices"],
    diagonal: float,
) -> Float[np.ndarray, "poses vertices modes"]:
    """Return orthonormal patterns of each pose, the smoothest first, 0 at what does not count."""
    least = int(counted.sum(axis=1).min())
    count = min(_MOST, least // 4)
    count = count if count >= _FEWEST else 0
    modes = np.zeros((*counted.shape, count))
    if not count:
        return modes
    known: dict[bytes, np.ndarray] = {}
    for pose, mask in enumerate(counted):
        key = mask.tobytes()
        if key not in known:
            known[key] = _eigenvectors(points[mask], _LENGTH * diagonal, count)
        modes[pose, mask] = known[key]
    return modes


def _eigenvectors(points, length: float, count: int) -> Float[np.ndarray, "points modes"]:
    """Return the leading eigenvectors of exp(-distance / length)."""
    n = len(points)
    sample = np.arange(n)
    if n > _SAMPLE:
        sample = np.sort(np.random.default_rng(0).choice(n, _SAMPLE, replace=False))
    kernel = _kernel(points[sample], points[sample], length)
    values, vectors = np.linalg.eigh(kernel)
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    if n > _SAMPLE:
        vectors, _ = np.linalg.qr(_kernel(points, points[sample], length) @ (vectors / values))
    return vectors


def _kernel(a, b, length: float) -> Float[np.ndarray, "a b"]:
    squares = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
    return np.exp(-np.sqrt(np.maximum(squares, 0.0)) / length)
