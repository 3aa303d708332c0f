"""Generated meshes to try things on: bar, cactus, cylinder, octopus, square."""

import numpy as np

from jaxdeform._mesh.implicit_shapes import cactus, octopus
from jaxdeform._mesh.mesh import Mesh

__all__ = ["bar", "cactus", "cylinder", "octopus", "square"]


def __dir__() -> list[str]:
    """Return what tab completion offers: no helpers."""
    return __all__


def bar() -> Mesh:
    """Return the thesis's bar (Table 5.1): 722 vertices, 1440 faces, 30 x 151 x 30, along y.

    A closed box of 6 x 27 x 6 nearly square patches, each cut along its diagonal.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.bar()
        Mesh(722 vertices, 1440 faces)
    """
    counts, size = np.array([6, 27, 6]), np.array([30.0, 151.0, 30.0])
    points: dict[tuple[int, ...], int] = {}
    faces = []

    def index(*at: int) -> int:
        return points.setdefault(at, len(points))

    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, counts[axis]):
            for i in range(counts[u]):
                for j in range(counts[v]):
                    corner = []
                    for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        at = [0, 0, 0]
                        at[axis], at[u], at[v] = int(side), i + di, j + dj
                        corner.append(index(*at))
                    a, b, c, d = corner if side else corner[::-1]
                    faces += [(a, b, c), (a, c, d)]
    grid = np.array(list(points), dtype=np.float64)
    return Mesh(grid / counts * size - np.array([15.0, 0.0, 15.0]), faces)


def cylinder() -> Mesh:
    """Return a closed cylinder with 4802 vertices and 9600 faces, along y, as in the survey.

    120 rings of 40 vertices, of which the outer ten at each end shrink to a pole of valence 40.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.cylinder()
        Mesh(4802 vertices, 9600 faces)
    """
    around, caps, radius, height = 40, 10, 1.0, 12.0
    lids = radius * np.arange(1, caps + 1) / (caps + 1)
    wall = 120 - 2 * caps
    radii = np.concatenate([lids, np.full(wall, radius), lids[::-1]])
    heights = np.concatenate([np.zeros(caps), np.linspace(0, height, wall), np.full(caps, height)])
    angle = 2 * np.pi * np.arange(around) / around
    rings = np.stack(
        [
            radii[:, None] * np.cos(angle),
            np.broadcast_to(heights[:, None], (120, around)),
            radii[:, None] * np.sin(angle),
        ],
        axis=-1,
    )
    vertices = np.concatenate([[[0, 0, 0]], rings.reshape(-1, 3), [[0, height, 0]]])
    faces = []
    here, there = np.arange(around), np.roll(np.arange(around), -1)
    for ring in range(119):
        low, high = 1 + ring * around, 1 + (ring + 1) * around
        faces.append(np.stack([low + here, high + here, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, low + there], axis=1))
    last = 1 + 119 * around
    faces.append(np.stack([0 * here, 1 + here, 1 + there], axis=1))
    faces.append(np.stack([0 * here + last + around, last + there, last + here], axis=1))
    return Mesh(vertices, np.concatenate(faces))


def square() -> Mesh:
    """Return the 3 x 3 square of thesis Fig. 4.1: side 2, centre vertex (index 4) at the origin.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.square().vertices[4]
        array([0., 0., 0.])
    """
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(9)], axis=1)
    low = np.array([0, 1, 3, 4])
    faces = np.concatenate(
        [np.stack([low, low + 1, low + 4], 1), np.stack([low, low + 4, low + 3], 1)]
    )
    return Mesh(vertices, faces)
