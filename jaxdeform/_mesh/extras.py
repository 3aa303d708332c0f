"""Colours and texture coordinates of a file, to be drawn, or written into another format."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxdeform._mesh.obj import all_keywords as obj_keywords
from jaxdeform._mesh.obj import color_words as obj_words
from jaxdeform._mesh.obj import corner_texture as obj_texture
from jaxdeform._mesh.off import color_words as off_words
from jaxdeform._mesh.off import has_face_colors
from jaxdeform._mesh.parsed import Extras, Source
from jaxdeform._mesh.ply import vertex_columns, vertex_kinds
from jaxdeform._mesh.ply_header import parse_header
from jaxdeform._mesh.ply_texture import corner_texture as ply_texture
from jaxdeform._mesh.reading import without_mark
from jaxdeform._mesh.words import real

# What every format holds, or is made anew, or goes along into a PLY.
_PLY_KNOWN = {
    "vertex": {
        *("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"),
        *("s", "t", "u", "v", "texture_u", "texture_v"),
    },
    "face": {"vertex_indices", "vertex_index", "texcoord"},
    "tristrips": {"vertex_indices", "vertex_index"},
}


def file_extras(source: Source | None) -> Extras:
    """Return what the file has of them."""
    return Extras(file_colors(source), file_texture(source)) if source else Extras()


def file_colors(source: Source | None) -> Float[np.ndarray, "vertices 3"] | None:
    """Return red, green and blue from 0 to 1 of each vertex, if the file has them.

    PLY has properties red, green and blue; OBJ and OFF have numbers behind the position.
    """
    if source is None:
        return None
    read = {".ply": _ply_colors, ".obj": _obj_colors, ".off": _off_colors}.get(source.suffix)
    found = read(without_mark(source.data)) if read else None
    if found is None or found.given.shape != source.points.shape:
        return None
    if not np.isfinite(found.given).all():
        return None
    return (found.given / (255.0 if found.bytes else 1.0)).clip(0, 1)


class _Colors(NamedTuple):
    given: np.ndarray
    bytes: bool
    """Whether they run to 255, instead of 1."""


def _ply_colors(data: bytes) -> _Colors | None:
    columns = vertex_columns(Path("mesh.ply"), data)
    names = ("red", "green", "blue")
    if not set(names) <= set(columns):
        return None
    given = np.stack([columns[name] for name in names], axis=1)
    whole = vertex_kinds(data)["red"][0] != "f"
    return _Colors(given, whole or bool(given.max(initial=0) > 1))


def _obj_colors(data: bytes) -> _Colors | None:
    given = _numbers([row[:3] for row in obj_words(data)])
    return None if given is None else _Colors(given, bool(given.max(initial=0) > 1))


def _off_colors(data: bytes) -> _Colors | None:
    words = off_words(data)
    given = _numbers([row[:3] for row in words])
    if given is None:
        return None
    # The opacity tells too: 255 behind a colour that is nearly black.
    opacity = _numbers([row[3:4] for row in words if row[3:4]])
    largest = max(given.max(initial=0), 0 if opacity is None else opacity.max(initial=0))
    return _Colors(given, bool(largest > 1))


def _numbers(words: list[list[bytes]]) -> np.ndarray | None:
    try:
        return np.array([[real(word) for word in row] for row in words])
    except ValueError:  # no numbers, or not in every row: then it is something else
        return None


def file_texture(source: Source) -> Float[np.ndarray, "corners 2"] | None:
    """Return the texture coordinates of each corner of each polygon, if the file has them."""
    read = {".ply": ply_texture, ".obj": obj_texture}.get(source.suffix)
    found = read(without_mark(source.data), source.polygons) if read else None
    return None if found is None or np.isnan(found).all() else found


def of_own_format(source: Source | None, found: Extras) -> list[str]:
    """Return in words what, besides its extras, only the file's own format is written with."""
    if source is None:
        return []
    data = without_mark(source.data)
    if source.suffix == ".obj":
        used = Counter(obj_keywords(data))
        groups = ["groups"] if used[b"g"] + used[b"o"] > 1 else []  # one is the whole mesh
        materials = ["materials"] if used[b"usemtl"] else []
        some = ["colours of some vertices"] if found.colors is None and any(obj_words(data)) else []
        lines = ["lines"] if used[b"l"] else []
        points = ["points"] if used[b"p"] else []
        return [*groups, *materials, *some, *lines, *points]
    if source.suffix == ".off":
        return ["colours of faces"] if has_face_colors(data) else []
    if source.suffix == ".ply":
        header = parse_header(Path("its source"), data)
        return [
            f"{item.name} {name}"
            for item in header.elements
            for name in item.names()
            if name not in _PLY_KNOWN.get(item.name, ())
        ]
    return []
