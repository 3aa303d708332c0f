"""What a reader of files returns, and what a mesh remembers of its file."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxdeform._mesh.polygons import Polygons


class Parsed(NamedTuple):
    """What a file says of a mesh, valid or not."""

    points: Float[np.ndarray, "points 3"]
    polygons: Polygons
    trailing: int = 0
    """The number of bytes behind the end of what the format describes."""


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
