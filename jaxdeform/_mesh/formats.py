"""Mesh formats: OBJ, OFF, PLY and STL, from bytes to a mesh and back."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdeform._mesh.obj import parse_obj, rewrite_obj, to_obj
from jaxdeform._mesh.off import parse_off, rewrite_off, to_off
from jaxdeform._mesh.parsed import Extras, Parsed
from jaxdeform._mesh.ply import parse_ply, rewrite_ply
from jaxdeform._mesh.ply_writing import to_ply
from jaxdeform._mesh.polygons import Polygons
from jaxdeform._mesh.stl import parse_stl, rewrite_stl, to_stl


class Format(NamedTuple):
    """How to read and write one kind of file."""

    parse: Callable[[Path, bytes], Parsed]
    """From (path, content) to positions and polygons, or InputError; the path is for its text."""
    to_bytes: Callable[[np.ndarray, Polygons, Extras], bytes]
    """From positions, polygons and what else the format holds to the content of a new file."""
    rewrite: Callable[[bytes, np.ndarray, Polygons], bytes]
    """From (content, positions, polygons) to the content with these positions, all else kept."""
    holds: frozenset[str]
    """The fields of `Extras` that the format has a place for."""


FORMATS = {
    ".obj": Format(parse_obj, to_obj, rewrite_obj, frozenset({"colors", "texture"})),
    ".off": Format(parse_off, to_off, rewrite_off, frozenset({"colors"})),
    ".ply": Format(parse_ply, to_ply, rewrite_ply, frozenset({"colors", "texture"})),
    ".stl": Format(parse_stl, to_stl, rewrite_stl, frozenset()),
}
