"""Mesh formats: OBJ, OFF, PLY and STL, from bytes to arrays and back."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._errors import InputError


def _broken(path: Path, what: str) -> InputError:
    return InputError(f"{path}: {what}: the file is truncated or damaged; export it again")


def _polygon(path: Path, where: str, corners: int) -> InputError:
    if corners > 3:
        return InputError(
            f"{path}: {where} is a polygon with {corners} corners: export it as a triangle mesh"
        )
    return _broken(path, f"{where} is a face with {corners} corners")


def _rows(data: bytes) -> list[list[bytes]]:
    """Return the words of each line; comments and empty lines are left out."""
    rows = (line.split(b"#", 1)[0].split() for line in data.splitlines())
    return [row for row in rows if row]


def _vertices(
    path: Path, rows: list[list[bytes]], columns: slice
) -> Float[np.ndarray, "rows columns"]:
    """Return these columns of the rows as numbers, at least three."""
    out = []
    for row in rows:
        try:
            x, y, z, *more = map(float, row[columns])
        except ValueError:
            raise _broken(path, f"the line {_shown(row)} is not a vertex") from None
        out.append((x, y, z, *more))
    return np.array(out, np.float64) if out else np.empty((0, 3))


def _triangles(path: Path, rows: list[list[bytes]]) -> Int[np.ndarray, "faces 3"]:
    """Return the faces from rows of the form ``3 i j k ...``."""
    out = np.empty((len(rows), 3), np.int64)
    for k, row in enumerate(rows):
        try:
            corners = int(row[0])
            if corners != 3:
                raise _polygon(path, f"face {k}", corners)
            out[k] = int(row[1]), int(row[2]), int(row[3])
        except InputError:
            raise
        except (ValueError, IndexError, OverflowError):
            raise _broken(path, f"the line {_shown(row)} is not a face") from None
    return out


def _shown(row: list[bytes]) -> str:
    return repr(b" ".join(row)[:40].decode("ascii", "replace"))


def _parse_obj(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    points, corners = [], []
    for number, line in enumerate(data.splitlines(), 1):
        words = line.split(b"#", 1)[0].split()
        if words[:1] == [b"v"]:
            points.append(words[1:])
        elif words[:1] == [b"f"]:
            if len(words) != 4:
                raise _polygon(path, f"line {number}", len(words) - 1)
            try:
                face = [int(word.split(b"/", 1)[0]) for word in words[1:]]
            except ValueError:
                raise _broken(path, f"line {number} is not a face") from None
            # Negative indices count back from the last vertex so far.
            corners.append([k - 1 if k > 0 else len(points) + k if k < 0 else -1 for k in face])
    vertices = _vertices(path, points, slice(3))
    announced = {kind: int(count) for kind, count in _OBJ_COUNT.findall(data)}
    for kind, found in ((b"Vertices", points), (b"Faces", corners)):
        if len(found) < announced.get(kind, 0):
            raise _broken(
                path, f"announces {announced[kind]} {kind.decode().lower()} but holds fewer"
            )
    try:
        return vertices, np.array(corners, np.int64).reshape(-1, 3)
    except OverflowError:
        raise _broken(path, "names a vertex out of range") from None


# MeshLab writes these counts too. Without them a truncated OBJ could not be recognised.
_OBJ_COUNT = re.compile(rb"^# (Vertices|Faces): (\d{1,12})\s*$", re.MULTILINE)


def _to_obj(points: np.ndarray, faces: np.ndarray) -> bytes:
    lines = [f"# Vertices: {len(points)}", f"# Faces: {len(faces)}"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    lines += [f"f {i} {j} {k}" for i, j, k in (faces + 1).tolist()]
    return _text(lines)


def _text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def _parse_off(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    rows = _rows(data)
    # COFF, NOFF and the like add colours or normals after the position. 4OFF changes the position.
    if not rows or not re.fullmatch(rb"(ST)?C?N?OFF", rows[0][0], re.IGNORECASE):
        raise InputError(f"{path}: does not start with OFF: check that it is an OFF file")
    # The counts are on the first line or on the next.
    head = rows[0][1:] or (rows[1] if len(rows) > 1 else [])
    body = rows[1 if rows[0][1:] else 2 :]
    try:
        n, m = int(head[0]), int(head[1])
    except (IndexError, ValueError):
        raise _broken(path, "has no counts of vertices and faces") from None
    if not 0 <= n + m <= len(body) or min(n, m) < 0:
        raise _broken(path, f"announces {n} vertices and {m} faces but holds fewer")
    return _vertices(path, body[:n], slice(3)), _triangles(path, body[n : n + m])


def _to_off(points: np.ndarray, faces: np.ndarray) -> bytes:
    lines = ["OFF", f"{len(points)} {len(faces)} 0"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    lines += [f"3 {i} {j} {k}" for i, j, k in faces.tolist()]
    return _text(lines)


_PLY_COUNTS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
}
_PLY_KINDS = {
    **_PLY_COUNTS,
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass(frozen=True)
class _PlyHeader:
    encoding: str
    size: int
    """Length of the header in bytes: the body starts here."""
    n_vertices: int
    n_faces: int
    vertex: list[tuple[str, str]]
    """(name, kind) of each property."""
    face: list[tuple[str, str, str]]
    """(name, kind of the count, kind of the entries); the count of a single number has no kind."""


def _ply_header(path: Path, data: bytes) -> _PlyHeader:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise _broken(path, "has no complete PLY header")
    size = data.find(b"\n", end) + 1 or len(data)
    encoding, elements = "", {}
    properties: list[tuple[str, str, str]] = []
    try:
        for line in data[:end].decode("ascii", "replace").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                encoding = words[1]
            elif words[:1] == ["element"]:
                properties = []
                elements[words[1]] = (int(words[2]), properties)
            elif words[:2] == ["property", "list"]:
                properties.append((words[4], _PLY_COUNTS[words[2]], _PLY_KINDS[words[3]]))
            elif words[:1] == ["property"]:
                properties.append((words[2], "", _PLY_KINDS[words[1]]))
        (n_vertices, vertex), (n_faces, face) = elements["vertex"], elements["face"]
    except (KeyError, IndexError, ValueError):
        raise _broken(path, "has a PLY header without vertices and faces") from None
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise _broken(path, f"has the unknown PLY format '{encoding}'")
    if list(elements)[:2] != ["vertex", "face"] or any(count for _, count, _ in vertex):
        raise InputError(
            f"{path}: its PLY elements are in an unusual order ({', '.join(elements)}): "
            "export it with plain vertices first, then faces"
        )
    if min(n_vertices, n_faces) < 0 or not {"x", "y", "z"} <= {name for name, *_ in vertex}:
        raise _broken(path, "has a PLY header without positions x, y, z")
    return _PlyHeader(
        encoding, size, n_vertices, n_faces, [(name, kind) for name, _, kind in vertex], face
    )


def ply_columns(path: Path, data: bytes) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the vertex properties by name, and the faces."""
    header = _ply_header(path, data)
    names = [name for name, *_ in header.face]
    which = next((k for k, name in enumerate(names) if name.startswith("vertex_ind")), -1)
    if which < 0 or not header.face[which][1]:
        raise _broken(path, "has a PLY header whose faces have no vertex_indices")
    read = _ply_ascii if header.encoding == "ascii" else _ply_binary
    return read(path, data, header, which)


def _ply_ascii(path: Path, data: bytes, header: _PlyHeader, which: int):
    rows = [row for row in (line.split() for line in data[header.size :].splitlines()) if row]
    n, m, width = header.n_vertices, header.n_faces, len(header.vertex)
    short = next((row for row in rows[:n] if len(row) < width), None)
    if len(rows) < n + m or short:
        raise _broken(path, f"announces {n} vertices and {m} faces but holds fewer")
    table = _vertices(path, rows[:n], slice(width)).reshape(n, width)
    faces = rows[n : n + m]
    for _, count, _ in header.face[:which]:  # properties before the corners
        try:
            faces = [row[1 + int(row[0]) if count else 1 :] for row in faces]
        except (IndexError, ValueError):
            raise _broken(path, "has a line that is not a face") from None
    columns = {name: table[:, k].copy() for k, (name, _) in enumerate(header.vertex)}
    return columns, _triangles(path, faces)


def _ply_binary(path: Path, data: bytes, header: _PlyHeader, which: int):
    order = "<" if header.encoding == "binary_little_endian" else ">"
    corners = header.face[which][0]
    try:
        record = np.dtype([(name, order + kind) for name, kind in header.vertex])
        table = np.frombuffer(data, record, header.n_vertices, header.size)
        begin = header.size + table.nbytes
        # Assume that lists are as long in every face as in the first; checked below.
        fields, lists, at = [], [], begin
        for name, count, kind in header.face if header.n_faces else []:
            length = 1
            if count:
                length = int(np.frombuffer(data, order + count, 1, at)[0])
                if name == corners and length != 3:
                    raise _polygon(path, "face 0", length)
                lists.append((name, length))
                fields.append((f"length of {name}", order + count))
            fields.append((name, order + kind, (length,)))
            at = begin + np.dtype(fields).itemsize
        faces = np.frombuffer(data, np.dtype(fields), header.n_faces, begin)
    except InputError:
        raise
    except ValueError:
        raise _broken(path, "is shorter than its header announces") from None
    for name, length in lists:
        sizes = faces[f"length of {name}"]
        other = np.flatnonzero(sizes != length)
        if other.size and name == corners:
            raise _polygon(path, f"face {other[0]}", int(sizes[other[0]]))
        if other.size:
            raise _broken(path, f"face {other[0]} has a list '{name}' of another length")
    columns = {name: table[name].astype(np.float64) for name, _ in header.vertex}
    return columns, faces[corners].astype(np.int64) if len(faces) else np.empty((0, 3), np.int64)


def _parse_ply(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    columns, faces = ply_columns(path, data)
    return np.stack([columns[axis] for axis in "xyz"], axis=1), faces


def to_ply(points: np.ndarray, faces: np.ndarray, rigidity: np.ndarray | None = None) -> bytes:
    """Return the content of a binary PLY file, with the vertex property rigidity if given."""
    columns = dict(zip("xyz", points.T, strict=True))
    if rigidity is not None:
        columns["rigidity"] = np.broadcast_to(rigidity, len(points))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {name}" for name in columns]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    triangles = np.empty(len(faces), np.dtype([("length", "u1"), ("corners", "<i4", (3,))]))
    triangles["length"], triangles["corners"] = 3, faces
    table = np.stack(list(columns.values()), axis=1).astype("<f8")
    return _text(lines) + table.tobytes() + triangles.tobytes()


_STL_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("more", "<u2")])


def _parse_stl(path: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if count > 0 and len(data) == 84 + _STL_FACET.itemsize * count:
        corners = np.frombuffer(data, _STL_FACET, count, 84)["corners"].reshape(-1, 3)
    elif data.lstrip().startswith(b"solid"):
        corners = _stl_ascii(path, data)
    else:
        raise _broken(path, "is neither ASCII STL nor as long as its face count says")
    return corners.astype(np.float64), np.arange(len(corners)).reshape(-1, 3)


def _stl_ascii(path: Path, data: bytes) -> Float[np.ndarray, "corners 3"]:
    rows = _rows(data)
    if rows[-1][0] != b"endsolid":
        raise _broken(path, "does not end with endsolid")
    corners: list[list[bytes]] = []
    faces = 0
    for row in rows:
        if row[0] == b"vertex":
            corners.append(row)
        elif row[0] == b"endfacet":
            faces += 1
            if len(corners) != 3 * faces:
                raise _polygon(path, f"face {faces - 1}", len(corners) - 3 * (faces - 1))
    if len(corners) != 3 * faces:
        raise _broken(path, "has a face that does not end with endfacet")
    return _vertices(path, corners, slice(1, 4)).reshape(-1, 3)


def _to_stl(points: np.ndarray, faces: np.ndarray) -> bytes:
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facets = np.zeros(len(faces), _STL_FACET)
    facets["normal"] = normal / np.where(length > 0, length, 1.0)
    facets["corners"] = corner
    return b"STL".ljust(80) + len(faces).to_bytes(4, "little") + facets.tobytes()


class Format(NamedTuple):
    """How to read and write one kind of file."""

    parse: Callable[[Path, bytes], tuple[np.ndarray, np.ndarray]]
    """From (path, content) to vertices and faces, or InputError; the path is for its text."""
    to_bytes: Callable[[np.ndarray, np.ndarray], bytes]
    """From vertices and faces to the content of a file."""


FORMATS = {
    ".obj": Format(_parse_obj, _to_obj),
    ".off": Format(_parse_off, _to_off),
    ".ply": Format(_parse_ply, to_ply),
    ".stl": Format(_parse_stl, _to_stl),
}
