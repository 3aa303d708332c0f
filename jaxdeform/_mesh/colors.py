"""The colours that a file gives to its vertices."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.off import color_words as off_words
from jaxdeform._mesh.ply import vertex_columns


def file_colors(mesh: Mesh) -> Float[np.ndarray, "vertices 3"] | None:
    """Return red, green and blue from 0 to 1 of each vertex, if the mesh's file has them.

    PLY has properties red, green and blue; OBJ and OFF have numbers behind the position.
    """
    source = mesh.source
    if source is None:
        return None
    if source.suffix == ".ply":
        columns = vertex_columns(Path("mesh.ply"), source.data)
        if not {"red", "green", "blue"} <= set(columns):
            return None
        given = np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
    else:
        words = {".obj": _obj_words, ".off": off_words}.get(source.suffix, lambda _: [])
        try:
            given = np.array([[float(word) for word in row] for row in words(source.data)])
        except ValueError:  # no numbers, or not in every row: then it is something else
            return None
    if given.shape != mesh.vertices.shape or not np.isfinite(given).all():
        return None
    return (given / (255.0 if given.max() > 1 else 1.0)).clip(0, 1)


def _obj_words(data: bytes) -> list[list[bytes]]:
    rows = (line.split() for line in data.splitlines() if line.lstrip().startswith(b"v"))
    return [row[4:7] for row in rows if row[0] == b"v"]
