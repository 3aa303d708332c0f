"""Texture coordinates in PLY files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._mesh.ply import vertex_columns
from jaxdeform._mesh.ply_body import Field, binary_fields, text_place, text_rows
from jaxdeform._mesh.ply_header import Element, Header, parse_header
from jaxdeform._mesh.ply_writing import TEXTURE
from jaxdeform._mesh.polygons import Polygons
from jaxdeform._mesh.words import real, whole

# As Blender, MeshLab and others name those of a vertex.
_PAIRS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def corner_texture(data: bytes, polygons: Polygons) -> Float[np.ndarray, "corners 2"] | None:
    """Return the texture coordinates of each corner; NaN where its face has none."""
    path = Path("its source")
    header = parse_header(path, data)
    face, names = header.element("face"), header.vertex.names()
    if face is not None and TEXTURE in face.names() and face.count == len(polygons.sizes):
        sizes, values = _lists(path, data, header, face)
        own = sizes == 2 * polygons.sizes
        out = np.full((len(polygons.corners), 2), np.nan)
        out[np.repeat(own, polygons.sizes)] = values[np.repeat(own, sizes)].reshape(-1, 2)
        return out
    for pair in _PAIRS:
        if set(pair) <= set(names):
            columns = vertex_columns(path, data)
            return np.stack([columns[name] for name in pair], axis=1)[polygons.corners]
    return None


def _lists(
    path: Path, data: bytes, header: Header, face: Element
) -> tuple[Int[np.ndarray, "faces"], Float[np.ndarray, "values"]]:
    if header.order:
        field: Field = binary_fields(path, data, header)[0]["face", TEXTURE]
        return field.sizes, field.take(data).astype(np.float64)
    lines, rows, _ = text_rows(path, data, header)
    sizes: list[int] = []
    values: list[float] = []
    for k in rows["face"]:
        words = lines[k].split()
        at = text_place(words, face, TEXTURE)
        sizes.append(whole(words[at]))
        values += map(real, words[at + 1 : at + 1 + sizes[-1]])
    return np.array(sizes), np.array(values)
