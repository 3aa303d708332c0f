"""PLY files, binary and text: read, write, and rewrite with other positions."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxdeform._mesh.normals import vertex_normals
from jaxdeform._mesh.parsed import Parsed
from jaxdeform._mesh.ply_body import Field, binary_fields, text_place, text_rows
from jaxdeform._mesh.ply_header import (
    INTEGERS,
    Element,
    Header,
    header_bytes,
    parse_header,
    with_property_lines,
)
from jaxdeform._mesh.polygons import (
    Polygons,
    area_vectors,
    from_lists,
    from_triangles,
    unit,
)
from jaxdeform._mesh.words import damaged, excerpt, polygon, real, with_words

_NORMAL = ("nx", "ny", "nz")


def parse_ply(path: Path, data: bytes) -> Parsed:
    """Read positions, and polygons or triangle strips."""
    header = parse_header(path, data)
    columns, polygons, trailing = _parse_body(path, data, header)
    return Parsed(np.stack([columns[axis] for axis in "xyz"], axis=1), polygons, trailing)


def vertex_columns(path: Path, data: bytes) -> dict[str, Float[np.ndarray, "vertices"]]:
    """Return the properties of the vertices by name."""
    return _parse_body(path, data, parse_header(path, data))[0]


def vertex_kinds(data: bytes) -> dict[str, str]:
    """Return the types of the properties of the vertices by name."""
    properties = parse_header(Path("its source"), data).vertex.properties
    return {item.name: item.kind for item in properties}


def _parse_body(
    path: Path, data: bytes, header: Header
) -> tuple[dict[str, np.ndarray], Polygons, int]:
    surface, corners = _surface(path, header)
    vertex = header.vertex
    if header.order:
        fields, end = binary_fields(path, data, header)
        taken = {name: fields["vertex", name].take(data) for name in vertex.names()}
        columns = {name: values.astype(np.float64) for name, values in taken.items()}
        polygons = Polygons(np.empty(0, np.int64), np.empty(0, np.int64))
        if surface:
            field: Field = fields[surface.name, corners]
            polygons = Polygons(field.sizes, field.take(data).astype(np.int64))
        trailing = len(data) - end
    else:
        lines, rows, behind = text_rows(path, data, header)
        trailing = sum(len(lines[k]) for k in behind)
        table = [_numbers(path, lines[k].split(), len(vertex.properties)) for k in rows["vertex"]]
        array = np.array(table, np.float64).reshape(-1, len(vertex.properties))
        columns = {name: array[:, k].copy() for k, name in enumerate(vertex.names())}
        found = (
            [_corners(path, lines[k], surface, corners) for k in rows[surface.name]]
            if surface
            else []
        )
        try:
            polygons = from_lists(list(map(len, found)), [k for face in found for k in face])
        except OverflowError:
            raise damaged(path, "names a vertex out of range") from None
    if surface and surface.name == "tristrips":
        polygons = from_triangles(_strip_triangles(polygons))
    small = np.flatnonzero(polygons.sizes < 3)
    if small.size:
        size = int(polygons.sizes[small[0]])
        raise damaged(path, f"face {small[0]} is a face with {size} corners")
    return columns, polygons, trailing


def _surface(path: Path, header: Header) -> tuple[Element | None, str]:
    """Return the element that holds the surface, and its property with the corners."""
    for name in ("face", "tristrips"):
        element = header.element(name)
        if element is None or (
            name == "face" and not element.count and header.element("tristrips")
        ):
            continue
        for item in element.properties:
            if item.name.startswith("vertex_ind") and item.count and item.kind in INTEGERS.values():
                return element, item.name
        raise damaged(path, f"has a PLY header whose element '{name}' has no list vertex_indices")
    return None, ""


def _numbers(path: Path, words: list[bytes], width: int) -> list[float]:
    try:
        row = list(map(real, words[:width]))
    except ValueError:
        row = []
    if len(row) < width:
        raise damaged(path, f"the line {excerpt(words)} is not a vertex")
    return row


def _corners(path: Path, line: bytes, element: Element, name: str) -> list[int]:
    words = line.split()
    try:
        at = text_place(words, element, name)
        if len(element.properties) > 1 and text_place(words, element, "") > len(words):
            raise IndexError
    except (ValueError, IndexError):
        raise damaged(path, f"the line {excerpt(words)} is not a face") from None
    if element.name == "tristrips":
        return polygon(path, "the strip", words[at:])
    return polygon(path, "the line", words[at:])


def _strip_triangles(strips: Polygons) -> np.ndarray:
    """Return the triangles of strips. -1 ends one; every second triangle is turned over."""
    # A -1 between two strips of the file, too.
    ends = np.cumsum(strips.sizes)
    corners = np.insert(strips.corners, ends, -1)
    at = np.arange(len(corners))
    begin = np.maximum.accumulate(np.where(corners < 0, at + 1, 0))
    begin = np.append(0, begin)[:-1]
    rows = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    odd = (at - begin)[:-2] % 2 == 1
    rows[odd] = rows[odd][:, [1, 0, 2]]
    a, b, c = rows.T
    # A strip is turned around a corner by naming a vertex twice: such triangles are none.
    return rows[(rows >= 0).all(axis=1) & (a != b) & (b != c) & (c != a)]


def rewrite_ply(
    data: bytes, points: np.ndarray, polygons: Polygons, rigidity: np.ndarray | None = None
) -> bytes:
    """Return a file with other positions, and normals computed anew; all else stays.

    Positions keep their type if it holds all their digits; otherwise they become ``double``.
    """
    path = Path("its source")
    header = parse_header(path, data)
    names = header.vertex.names()
    kinds = {item.name: item.kind for item in header.vertex.properties}
    values = dict(zip("xyz", points.T, strict=True))
    types = {}
    if any(_loses(points[:, k], kinds[axis]) for k, axis in enumerate("xyz")):
        types = dict.fromkeys("xyz", "double")
    if set(_NORMAL) <= set(names):
        values |= zip(_NORMAL, vertex_normals(points, polygons).T, strict=True)
    if rigidity is not None:
        values["rigidity"] = np.broadcast_to(rigidity, len(points))
        types["rigidity"] = "double"
    added = [name for name in values if name not in names]
    kinds |= dict.fromkeys(types, "f8")
    head = header_bytes(with_property_lines(header, types, added))
    write = _rewritten_binary if header.order else _rewritten_text
    return head + write(path, data, header, values, kinds, unit(area_vectors(points, polygons)))


def _loses(values: np.ndarray, kind: str) -> bool:
    """Return whether a type cannot hold these values."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool((values.astype(kind).astype(np.float64) != values).any())


def _rewritten_binary(path, data, header, values, kinds, face_normals) -> bytes:
    fields, _ = binary_fields(path, data, header)
    content = bytearray(data)
    face = header.element("face")
    if face and set(_NORMAL) <= set(face.names()):
        for name, column in zip(_NORMAL, face_normals.T, strict=True):
            fields["face", name].put(content, column)
    vertex = header.vertex
    old = np.dtype([(item.name, header.order + item.kind) for item in vertex.properties])
    first = vertex.names()[0]
    begin = int(fields["vertex", first].offsets.min(initial=len(data)))
    end = begin + old.itemsize * vertex.count
    before = np.frombuffer(data, old, vertex.count, begin)
    table = np.empty(vertex.count, [(name, header.order + kind) for name, kind in kinds.items()])
    for name in kinds:
        table[name] = values[name] if name in values else before[name]
    return bytes(content[header.size : begin]) + table.tobytes() + bytes(content[end:])


def _rewritten_text(path, data, header, values, kinds, face_normals) -> bytes:
    lines, rows, _ = text_rows(path, data, header, keepends=True)
    vertex = header.vertex
    columns = {name: _texts(column, kinds[name], name) for name, column in values.items()}
    for row, k in enumerate(rows["vertex"]):
        words = lines[k].split()
        for at, name in enumerate(vertex.names()):
            if name in columns:
                words[at] = columns[name][row]
        line = with_words(lines[k], 0, words)
        more = [columns[name][row] for name in columns if name not in vertex.names()]
        bare = line.rstrip()
        lines[k] = b" ".join([bare, *more]) + line[len(bare) :]
    face = header.element("face")
    if face and set(_NORMAL) <= set(face.names()):
        for normal, k in zip(face_normals.tolist(), rows["face"], strict=True):
            words = lines[k].split()
            for name, value in zip(_NORMAL, normal, strict=True):
                words[text_place(words, face, name)] = b"%.6f" % value
            lines[k] = with_words(lines[k], 0, words)
    return b"".join(lines)


def _texts(column: np.ndarray, kind: str, name: str) -> list[bytes]:
    if name in _NORMAL:
        return [b"%.6f" % value for value in column.tolist()]
    if kind[0] != "f":
        return [b"%d" % value for value in column.tolist()]
    return [repr(value).encode() for value in column.tolist()]
