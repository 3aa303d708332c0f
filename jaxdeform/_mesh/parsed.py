"""What a reader of files returns, and what a mesh remembers of its file."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._arrays import read_only
from jaxdeform._mesh.polygons import Polygons


class Parsed(NamedTuple):
    """What a file says of a mesh, valid or not."""

    points: Float[np.ndarray, "points 3"]
    polygons: Polygons
    trailing: int = 0
    """The number of bytes behind the end of what the format describes."""


class Extras(NamedTuple):
    """What a file may say of a surface besides its shape, and another format can hold too."""

    colors: Float[np.ndarray, "vertices 3"] | None = None
    """Red, green and blue of each vertex, from 0 to 1."""
    texture: Float[np.ndarray, "corners 2"] | None = None
    """Texture coordinates of each corner of each polygon; NaN where there are none."""


@dataclass(frozen=True, eq=False)
class Source:
    """What a file held besides triangles, so that it can be written again with other positions."""

    suffix: str
    """Which format, such as ``.obj``."""
    data: bytes
    """The content, not compressed."""
    polygons: Polygons
    """The faces as the file gives them; their vertices are those of the mesh."""
    trailing: int
    """The number of bytes behind the end of what the format describes."""
    points: Float[np.ndarray, "points 3"]
    """The positions in the file."""
    path: Path
    """Where it was, for the files that it names."""

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for array in (*self.polygons, self.points):
            read_only(array)

    def __reduce__(self):
        """Pickle the content; loading freezes it again."""
        return Source, tuple(getattr(self, field.name) for field in fields(self))

    def fits(self, n_vertices: int, faces: Int[np.ndarray, "faces 3"]) -> bool:
        """Return whether a mesh is of this file: the polygons, cut in any way, at any positions."""
        sizes, corners = self.polygons
        if n_vertices != len(self.points) or len(faces) != int((sizes - 2).sum()):
            return False
        if (sizes == 3).all():
            return np.array_equal(faces, corners.reshape(-1, 3))
        polygon = np.arange(len(sizes)) * n_vertices
        own = np.repeat(polygon, sizes) + corners
        return bool(np.isin(np.repeat(polygon, sizes - 2)[:, None] + faces, own).all())
