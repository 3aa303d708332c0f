"""New PLY files."""

import numpy as np

from jaxdeform._mesh.parsed import Extras
from jaxdeform._mesh.ply_body import Field
from jaxdeform._mesh.polygons import Polygons
from jaxdeform._mesh.words import joined

# As MeshLab and VTK name the texture coordinates of the corners of a face.
TEXTURE = "texcoord"


def to_ply(
    points: np.ndarray, polygons: Polygons, extras: Extras, rigidity: np.ndarray | None = None
) -> bytes:
    """Return the content of a binary file, with the vertex property rigidity if given."""
    double = dict(zip("xyz", points.T, strict=True))
    if rigidity is not None:
        double["rigidity"] = np.broadcast_to(rigidity, len(points))
    columns = {name: ("double", "<f8", column) for name, column in double.items()}
    if extras.colors is not None:
        shades = np.rint(255 * extras.colors)
        for name, column in zip(("red", "green", "blue"), shades.T, strict=True):
            columns[name] = ("uchar", "u1", column)
    texture = extras.texture
    largest = int(polygons.sizes.max(initial=3)) * (1 if texture is None else 2)
    count, width = ("uchar", "u1") if largest < 256 else ("int", "<i4")
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {kind} {name}" for name, (kind, _, _) in columns.items()]
    lines += [
        f"element face {len(polygons.sizes)}",
        f"property list {count} int vertex_indices",
        *([] if texture is None else [f"property list {count} float {TEXTURE}"]),
        "end_header",
    ]
    table = np.empty(len(points), [(name, dtype) for name, (_, dtype, _) in columns.items()])
    for name, (_, _, column) in columns.items():
        table[name] = column
    return joined(lines) + table.tobytes() + _face_bytes(polygons, width, texture)


def _face_bytes(polygons: Polygons, width: str, texture: np.ndarray | None) -> bytes:
    """Return each polygon as its size and its corners, and as many texture coordinates or none."""
    sizes, corners = polygons
    lists: list[tuple[np.ndarray, np.ndarray, str]] = [(sizes, corners, "<i4")]
    if texture is not None:
        whole_ = np.logical_and.reduceat(~np.isnan(texture).any(axis=1), polygons.starts)
        given = texture[np.repeat(whole_, sizes)].ravel()
        lists.append((2 * sizes * whole_, given, "<f4"))
    wide = np.dtype(width).itemsize
    length = np.sum([wide + 4 * many for many, _, _ in lists], axis=0)
    begin = np.cumsum(length) - length
    out = bytearray(int(length.sum()))
    for many, values, dtype in lists:
        Field(begin, np.ones_like(many), np.dtype(width)).put(out, many)
        within = np.arange(len(values)) - np.repeat(np.cumsum(many) - many, many)
        places = np.repeat(begin + wide, many) + 4 * within
        Field(places, np.ones_like(places), np.dtype(dtype)).put(out, values)
        begin = begin + wide + 4 * many
    return bytes(out)
