"""Triangle meshes: reading, writing, checking, mending (thesis chapter 2)."""

import os
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import ArrayLike, Float, Int

SUFFIXES = (".obj", ".off", ".ply", ".stl")

# A triangle lower than this part of its longest edge has no area that float64 could tell from
# rounding; its cotangents would be noise. Thin but real ones (0.4 degrees) are 1e10 above it.
_FLAT = 1e-13


class InputError(ValueError):
    """Raised for every misuse: names vertex, face, file or argument, the reason, the next move."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, checked once, when it is made.

    Open borders, several components, unreferenced vertices, non-manifold edges and vertices, and
    faces turned inwards are all allowed; :func:`inspect` reports them.

    **Raises** InputError: arrays of the wrong shape or empty; a vertex that is not finite; a face
    index out of range; a face that repeats a vertex or has no area. :func:`repair` mends the last.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        Mesh(3 vertices, 1 faces)
    """

    vertices: Float[np.ndarray, "n 3"]
    """Positions, any unit of length."""
    faces: Int[np.ndarray, "m 3"]
    """Vertex indices, counter-clockwise seen from outside."""

    def __post_init__(self) -> None:
        """Check and freeze the arrays."""
        vertices, faces = _checked_arrays(self.vertices, self.faces)
        for reason, face in _degenerate(vertices, faces):
            raise InputError(
                f"face {face} {faces[face].tolist()} {reason}: drop such faces with "
                "jd.repair((vertices, faces))"
            )
        for name, array in (("vertices", vertices), ("faces", faces)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        """Number of faces."""
        return len(self.faces)

    @cached_property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Undirected edges (i < j), each once, sorted."""
        return _edges(self.faces)

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        return f"Mesh({self.n_vertices} vertices, {self.n_faces} faces)"


# A broken mesh cannot be made a Mesh, so what mends and inspects takes it in any of three forms.
MeshLike = Mesh | tuple[ArrayLike, ArrayLike] | str | os.PathLike


# ---------------------------------------------------------------- files


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Read a mesh from an OBJ, OFF, PLY or STL file.

    STL stores no shared vertices, so its exactly equal corners are merged. Polygons with more than
    three corners are refused, because how to cut them is the modeller's choice.

    **Raises** InputError: the file is missing, empty, truncated, unreadable or of another kind, or
    what it holds is no valid :class:`Mesh`.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.off"
        >>> jd.save_mesh(path, jd.shapes.bar())
        >>> jd.load_mesh(path)
        Mesh(722 vertices, 1440 faces)
    """
    vertices, faces = read_arrays(path)
    try:
        return Mesh(vertices, faces)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def save_mesh(
    path: str | os.PathLike,
    mesh: Mesh,
    *,
    vertices: ArrayLike | None = None,
    rigidity: ArrayLike | None = None,
) -> None:
    """Write a mesh as OBJ, OFF, PLY or STL, by the suffix of the path.

    The file is written beside its final place and then renamed, so that a file that was there is
    either kept whole or replaced whole. Binary PLY keeps every bit; OBJ and OFF keep 15 digits;
    STL keeps single precision.

    **Arguments**

    - path: where to.
    - mesh: the mesh.
    - vertices: (n, 3) positions to write instead of the rest positions: another pose of it.
    - rigidity: a number or (n,), written as the vertex property ``rigidity`` (PLY only).

    **Raises** InputError: unknown suffix, a folder that cannot be written, wrong shapes.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=0.5)
        >>> jd.load_rigidity(path)[:2]
        array([0.5, 0.5])
    """
    path = Path(path)
    suffix = _suffix(path)
    points = mesh.vertices if vertices is None else np.asarray(vertices, np.float64)
    if points.shape != mesh.vertices.shape:
        raise InputError(
            f"vertices have shape {points.shape}, the mesh has {mesh.vertices.shape}: a pose needs "
            "one position per vertex"
        )
    points = np.ascontiguousarray(points, np.float64)
    faces = np.ascontiguousarray(mesh.faces)
    data = None
    if rigidity is not None:
        if suffix != ".ply":
            raise InputError(f"{path}: only PLY carries rigidity per vertex: use a .ply name")
        given = np.asarray(rigidity, np.float64)
        if given.shape not in ((), (mesh.n_vertices,)):
            raise InputError(
                f"rigidity has shape {given.shape}: give one number or ({mesh.n_vertices},)"
            )
        data = np.ascontiguousarray(np.broadcast_to(given, (mesh.n_vertices,))[:, None])

    def write(name: str) -> None:
        if suffix == ".ply":
            extra = {} if data is None else {"VD": data, "VDheader": ["rigidity"]}
            igl.writePLY(name, points, faces, encoding=igl.FileEncoding.Binary, **extra)
        else:
            igl.write_triangle_mesh(name, points, faces)

    write_beside(path, write)


def write_beside(path: Path, write) -> None:
    """Call ``write(name)`` on a temporary file beside path, then move it into place.

    **Raises** InputError where the folder cannot be written; the file that was there is kept.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(suffix=path.suffix, prefix=".writing-", dir=path.parent)
    except OSError as error:
        raise InputError(
            f"{path}: cannot write there ({error.strerror}): check the folder"
        ) from error
    os.close(handle)
    try:
        write(name)
        mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
        os.chmod(name, mode)
        os.replace(name, path)
    except OSError as error:
        raise InputError(f"{path}: cannot write there ({error}): choose another name") from error
    finally:
        Path(name).unlink(missing_ok=True)


def check_output(path: str | os.PathLike) -> None:
    """Raise InputError if a mesh could not be written there: suffix or folder are wrong.

    Example:
        >>> import jaxdeform as jd
        >>> jd.check_output("bent.ply")
    """
    path = Path(path)
    _suffix(path)
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: cannot write there: make the folder {path.parent} first")


def load_rigidity(path: str | os.PathLike) -> Float[np.ndarray, "n"]:
    """Read the per-vertex rigidity of a PLY file that :func:`save_mesh` wrote.

    **Raises** InputError: no PLY file, or one without the vertex property ``rigidity``.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=2.0)
        >>> jd.load_rigidity(path).shape
        (722,)
    """
    path = Path(path)
    if _suffix(path) != ".ply":
        raise InputError(f"{path}: rigidity is kept in .ply files only")
    data = _read_bytes(path)
    header = _ply_header(path, data)
    _check_ply(path, data)
    names = [name for name, _ in header.vertex]
    if "rigidity" not in names:
        raise InputError(f"{path}: its vertices have no property 'rigidity' (only {names})")
    if header.encoding == "ascii":
        rows = data[header.size :].split(b"\n")[: header.n_vertices]
        return np.array([float(row.split()[names.index("rigidity")]) for row in rows])
    order = "<" if header.encoding == "binary_little_endian" else ">"
    record = np.dtype([(name, order + kind) for name, kind in header.vertex])
    table = np.frombuffer(data, record, header.n_vertices, header.size)
    return table["rigidity"].astype(np.float64)


def read_arrays(
    path: str | os.PathLike,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Read vertices and faces as they stand in the file, valid or not.

    libigl does the reading. It crashes the process on a truncated OBJ and never returns from an
    empty OFF, and drops half lines in silence, so each file is checked to be whole before.

    **Raises** InputError: missing, empty, truncated or unreadable file, unknown suffix, polygons.
    """
    path = Path(path)
    suffix = _suffix(path)
    data = _read_bytes(path)
    {".obj": _check_obj, ".off": _check_off, ".ply": _check_ply, ".stl": _check_stl}[suffix](
        path, data
    )
    try:
        vertices, faces = igl.read_triangle_mesh(str(path))
    except RuntimeError as error:
        raise InputError(f"{path}: libigl cannot read it: is it really {suffix}?") from error
    vertices = np.asarray(vertices, np.float64).reshape(-1, vertices.shape[-1] or 3)[:, :3]
    if faces.size == 0 or faces.shape[1] != 3:
        raise InputError(f"{path}: holds no triangles: export it as a triangle mesh")
    if suffix == ".stl":
        vertices, _, _, faces = igl.remove_duplicate_vertices(vertices, faces, 0.0)
    return vertices, np.asarray(faces, np.int64)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path}: unknown suffix '{path.suffix}': use one of {', '.join(SUFFIXES)}"
        )
    return suffix


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): check the name") from error
    if not data.strip():
        raise InputError(f"{path}: is empty: export the mesh again")
    return data


def _broken(path: Path, what: str) -> InputError:
    return InputError(f"{path}: {what}: the file is truncated or damaged; export it again")


def _check_obj(path: Path, data: bytes) -> None:
    count = sum(1 for line in data.splitlines() if line[:2] in (b"v ", b"v\t"))
    faces = 0
    for number, line in enumerate(data.splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            try:
                good = len([float(word) for word in words[1:]]) >= 3
            except ValueError:
                good = False
            if not good:
                raise _broken(path, f"line {number} is no vertex")
        elif words[0] == b"f":
            faces += 1
            try:
                corners = [int(word.split(b"/")[0]) for word in words[1:]]
            except ValueError:
                raise _broken(path, f"line {number} is no face") from None
            if len(corners) < 3:
                raise _broken(path, f"line {number} is a face with {len(corners)} corners")
            _no_polygon(path, len(corners), f"line {number}")
            for corner in corners:
                if corner == 0 or abs(corner) > count:
                    raise InputError(
                        f"{path}: line {number} names vertex {corner} of {count}: a face index is "
                        "out of range; export the mesh again"
                    )
    if not faces:
        raise _broken(path, "holds no faces")


def _check_off(path: Path, data: bytes) -> None:
    lines = [line.split(b"#")[0].split() for line in data.splitlines()]
    lines = [line for line in lines if line]
    if not lines[0][0].upper().endswith(b"OFF"):
        raise InputError(f"{path}: does not start with OFF: is it another kind of file?")
    head = lines[0][1:] or (lines[1] if len(lines) > 1 else [])
    body = lines[1 if lines[0][1:] else 2 :]
    try:
        n_vertices, n_faces = int(head[0]), int(head[1])
    except (IndexError, ValueError):
        raise _broken(path, "has no counts of vertices and faces") from None
    if len(body) < n_vertices + n_faces:
        raise _broken(path, f"announces {n_vertices} vertices and {n_faces} faces, and holds fewer")
    _check_rows(path, body[:n_vertices], body[n_vertices : n_vertices + n_faces])


def _check_rows(path: Path, vertices: list[list[bytes]], faces: list[list[bytes]]) -> None:
    try:
        for row in vertices:
            float(row[0]), float(row[1]), float(row[2])
    except (IndexError, ValueError):
        raise _broken(path, f"the line {b' '.join(row)[:40]!r} is no vertex") from None
    for row in faces:
        try:
            size = int(row[0])
            good = len([int(word) for word in row[1 : size + 1]]) == size >= 3
        except ValueError:
            good = False
        if not good:
            raise _broken(path, f"the line {b' '.join(row)[:40]!r} is no face")
        _no_polygon(path, size, f"a face of {size} corners")


def _no_polygon(path: Path, corners: int, where: str) -> None:
    if corners > 3:
        raise InputError(
            f"{path}: {where} is a polygon with {corners} corners: export it as a triangle mesh"
        )


def _check_stl(path: Path, data: bytes) -> None:
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + 50 * count and count > 0:
        return
    text = data.lstrip()
    if not text.startswith(b"solid"):
        raise _broken(path, "is neither ASCII STL nor as long as its count of faces says")
    if b"endsolid" not in text.splitlines()[-1]:
        raise _broken(path, "does not end with endsolid")
    if text.count(b"vertex") != 3 * text.count(b"endfacet") or b"endfacet" not in text:
        raise _broken(path, "holds faces that are not three corners")


_PLY_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass(frozen=True)
class _PlyHeader:
    encoding: str
    size: int
    n_vertices: int
    n_faces: int
    vertex: list[tuple[str, str]]
    face: list[tuple[str, ...]]


def _ply_header(path: Path, data: bytes) -> _PlyHeader:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise _broken(path, "has no complete PLY header")
    size = data.index(b"\n", end) + 1 if b"\n" in data[end:] else len(data)
    encoding, elements = "", {}
    properties: list[tuple[str, ...]] = []
    try:
        for line in data[:end].decode("ascii", "replace").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                encoding = words[1]
            elif words[:1] == ["element"]:
                properties = []
                elements[words[1]] = (int(words[2]), properties)
            elif words[:2] == ["property", "list"]:
                properties.append((words[4], _PLY_KINDS[words[2]], _PLY_KINDS[words[3]]))
            elif words[:1] == ["property"]:
                properties.append((words[2], _PLY_KINDS[words[1]]))
        (n_vertices, vertex), (n_faces, face) = elements["vertex"], elements["face"]
        pairs = [(name, kind) for name, kind in vertex]
    except (KeyError, IndexError, ValueError):
        raise _broken(path, "has a PLY header that names no vertices and faces") from None
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise _broken(path, f"has the unknown PLY format '{encoding}'")
    return _PlyHeader(encoding, size, n_vertices, n_faces, pairs, face)


def _check_ply(path: Path, data: bytes) -> None:
    header = _ply_header(path, data)
    body = data[header.size :]
    if header.encoding == "ascii":
        rows = [row for row in (line.split() for line in body.splitlines()) if row]
        if len(rows) < header.n_vertices + header.n_faces:
            raise _broken(
                path, f"announces {header.n_vertices} vertices and {header.n_faces} faces"
            )
        faces = rows[header.n_vertices : header.n_vertices + header.n_faces]
        # Only where the corners come first can a line be checked; that is nearly every file.
        first = len(header.face[0]) == 3
        _check_rows(path, rows[: header.n_vertices], faces if first else [])
        return
    record = sum(np.dtype(kind).itemsize for _, kind in header.vertex)
    needed = record * header.n_vertices
    if len(header.face) == 1 and len(header.face[0]) == 3:
        _, length, index = header.face[0]
        order = "<" if header.encoding == "binary_little_endian" else ">"
        triangle = np.dtype([("size", order + length), ("corners", order + index, (3,))])
        whole = len(body) >= needed + triangle.itemsize * header.n_faces
        if whole:
            sizes = np.frombuffer(body, triangle, header.n_faces, needed)["size"]
            other = np.flatnonzero(sizes != 3)
            if other.size:
                _no_polygon(path, int(sizes[other[0]]), f"face {other[0]}")
                raise _broken(path, f"face {other[0]} has {sizes[other[0]]} corners")
    else:
        whole = len(body) >= needed + header.n_faces
    if not whole:
        raise _broken(path, "is shorter than its header announces")


# ---------------------------------------------------------------- checks


def _checked_arrays(vertices: ArrayLike, faces: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return copies with valid shapes, finite vertices and indices in range, or raise."""
    try:
        points = np.array(vertices, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"vertices cannot be read as numbers: {error}") from error
    corners = np.array(faces, order="C")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"vertices have shape {points.shape}: give (n, 3) with n >= 1")
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) == 0:
        raise InputError(f"faces have shape {corners.shape}: give (m, 3) triangles with m >= 1")
    if corners.dtype.kind not in "iu":
        raise InputError(f"faces must be integers, got {corners.dtype}: give vertex indices")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"vertex {bad[0]} is {points[bad[0]].tolist()} ({bad.size} such): give finite positions"
        )
    corners = corners.astype(np.int64)
    bad = np.flatnonzero(((corners < 0) | (corners >= len(points))).any(axis=1))
    if bad.size:
        raise InputError(
            f"face {bad[0]} {corners[bad[0]].tolist()} names a vertex out of range: there are "
            f"vertices 0 to {len(points) - 1}"
        )
    return points, corners


def _degenerate(points: np.ndarray, faces: np.ndarray) -> list[tuple[str, int]]:
    """Return (reason, face) of the faces that repeat a vertex or have no area."""
    repeats = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    found = [("repeats a vertex", int(k)) for k in np.flatnonzero(repeats)]
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    # Scaled per face, so that neither tiny nor huge meshes leave the range of float64. Lengths are
    # compared with the coordinates too: what is below their rounding is not there.
    u, v, w = b - a, c - a, c - b
    longest = np.abs(np.concatenate([u, v, w], axis=1)).max(axis=1)
    size = np.where(longest > 0, longest, 1.0)[:, None]
    area = np.linalg.norm(np.cross(u / size, v / size), axis=1)
    flat = (area <= _FLAT) & ~repeats
    return found + [("has no area", int(k)) for k in np.flatnonzero(flat)]


def _edges(faces: np.ndarray) -> Int[np.ndarray, "edges 2"]:
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    # Encoded as one number a pair, because np.unique over rows is ten times slower.
    n = int(faces.max()) + 1
    code = np.unique(pairs[:, 0] * n + pairs[:, 1])
    return np.stack([code // n, code % n], axis=1)


def _arrays(mesh: MeshLike) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(mesh, Mesh):
        return mesh.vertices, mesh.faces
    if isinstance(mesh, (str, os.PathLike)):
        return read_arrays(mesh)
    try:
        vertices, faces = mesh
    except (TypeError, ValueError):
        raise InputError("give a Mesh, a pair (vertices, faces), or the path of a file") from None
    return np.asarray(vertices), np.asarray(faces)


# ---------------------------------------------------------------- mending and reporting


def repair(mesh: MeshLike) -> tuple[Mesh, Int[np.ndarray, "old"]]:
    """Merge duplicate vertices; drop degenerate and repeated faces and unreferenced vertices.

    **Arguments**: mesh, a :class:`Mesh`, a pair (vertices, faces), or the path of a file.

    **Returns** the new mesh and, for each old vertex, its new index or -1 where it was dropped.

    **Raises** InputError: indices out of range or vertices that are not finite (nothing sensible
    can be done), or no face is left.

    Example:
        >>> import jaxdeform as jd
        >>> vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [5, 5, 5]]
        >>> mesh, new = jd.repair((vertices, [[0, 1, 2], [0, 1, 3], [2, 3, 0]]))
        >>> mesh, new.tolist()
        (Mesh(3 vertices, 1 faces), [0, 1, 2, 2, -1])
    """
    points, faces = _checked_arrays(*_arrays(mesh))
    extent = np.ptp(points, axis=0).max()
    unit = points / extent if extent > 0 else points
    _, first, merged, _ = igl.remove_duplicate_vertices(unit, faces, 1e-12)
    first, merged = np.ravel(first), np.ravel(merged)
    # In the order of the old vertices, whatever order libigl merged them in.
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    points, merged = points[first[order]], rank[merged]
    faces = merged[faces]
    drop = np.array([face for _, face in _degenerate(points, faces)], dtype=np.int64)
    faces = np.delete(faces, drop, axis=0)
    _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(keep)]
    if not len(faces):
        raise InputError("no face with an area is left after mending: the mesh is empty")
    kept_points, kept_faces, new, _ = igl.remove_unreferenced(points, np.ascontiguousarray(faces))
    new = np.ravel(new).copy()
    new[~np.isin(np.arange(len(points)), faces)] = -1
    return Mesh(kept_points, kept_faces), new[merged]


@dataclass(frozen=True)
class Inspection:
    """What :func:`inspect` found; ``str()`` of it is a report."""

    counts: dict[str, int | float]
    """Sizes and measures by name."""
    findings: tuple[str, ...]
    """What is wrong or unusual, a sentence each, with what jaxdeform does about it."""

    def __str__(self) -> str:
        """Return the report."""
        width = max(len(name) for name in self.counts) if self.counts else 0
        lines = [f"{name:<{width}}  {value:g}" for name, value in self.counts.items()]
        lines += [f"- {finding}" for finding in self.findings] or ["- nothing unusual"]
        return "\n".join(lines)


def inspect(mesh: MeshLike) -> Inspection:
    """Report what is wrong or unusual with a mesh, broken ones included.

    **Arguments**: mesh, a :class:`Mesh`, a pair (vertices, faces), or the path of a file.
    **Raises** InputError only for a file that cannot be read.

    Example:
        >>> import jaxdeform as jd
        >>> jd.inspect(jd.shapes.bar()).findings
        ()
    """
    arrays = _arrays(mesh)
    try:
        points, faces = _checked_arrays(*arrays)
    except InputError as error:
        return Inspection({}, (f"Unusable: {error}",))
    n, m = len(points), len(faces)
    findings: list[str] = []

    def report(count: int, what: str, move: str) -> None:
        if count:
            findings.append(f"{count} {what}: {move}")

    bad = _degenerate(points, faces)
    repeating = [k for reason, k in bad if reason.startswith("repeats")]
    flat = [k for reason, k in bad if reason.startswith("has")]
    mend = "jd.repair drops them"
    report(len(repeating), f"faces repeat a vertex (face {(repeating or [0])[0]})", mend)
    report(len(flat), f"faces have no area (face {(flat or [0])[0]})", mend)
    sound = np.delete(faces, [k for _, k in bad], axis=0)
    unreferenced = n - len(np.unique(faces))
    report(unreferenced, "vertices belong to no face", "they stay where they are")
    duplicates = n - len(np.unique(points, axis=0))
    report(duplicates, "vertices lie exactly on another", "the mesh is not joined there; jd.repair")
    repeated = m - len(np.unique(np.sort(faces, axis=1), axis=0))
    report(repeated, "faces are there twice", "their edges weigh double; jd.repair drops them")
    counts: dict[str, int | float] = {"vertices": n, "faces": m}
    if len(sound):
        _inspect_structure(points, np.ascontiguousarray(sound), counts, report)
        _inspect_angles(points, sound, counts, report)
    return Inspection(counts, tuple(findings))


def _inspect_structure(points, faces, counts, report) -> None:
    edges = _edges(faces)
    counts["edges"] = len(edges)
    n = len(points)
    graph = sp.coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
    _, label = sp.csgraph.connected_components(graph, directed=False)
    used = np.unique(faces)
    components = len(np.unique(label[used]))
    counts["components"] = components
    report(components - 1, "further connected parts", "each needs a handle of its own")

    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs, inverse, times = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    border, crowded = int((times == 1).sum()), int((times > 2).sum())
    counts["border edges"] = border
    counts["Euler characteristic"] = len(used) - len(pairs) + len(faces)
    report(border, "edges lie on the border", "the surface is open there, which is fine")
    report(crowded, "edges have more than two faces", "non-manifold, deformed all the same")
    if not crowded:
        manifold = np.asarray(igl.is_vertex_manifold(faces)).ravel()
        report(
            int(
                (~manifold[: len(manifold)]).sum()
                - (len(manifold) - len(used[used < len(manifold)]))
            ),
            "vertices join surfaces that meet nowhere else",
            "non-manifold, deformed all the same",
        )
        ascending = np.where(directed[:, 0] < directed[:, 1], 1, -1)
        twist = np.bincount(inverse.ravel(), ascending)
        clash = int(((times == 2) & (twist != 0)).sum())
        report(clash, "edges have faces of opposite orientation", "harmless without normals=True")
    center = points[used].mean(axis=0)
    a, b, c = (points[faces[:, k]] - center for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    part = label[faces[:, 0]]
    open_parts = np.unique(label[pairs[times != 2][:, 0]])
    inward = [k for k in np.unique(part) if k not in open_parts and volume[part == k].sum() < 0]
    report(len(inward), "closed parts face inwards", "harmless: normals turn with the surface")


def _inspect_angles(points, faces, counts, report) -> None:
    corner = points[faces]
    edge = np.roll(corner, -1, axis=1) - corner
    length = np.linalg.norm(edge, axis=2)
    unit = edge / length[:, :, None]
    cosine = -np.einsum("ijk,ijk->ij", unit, np.roll(unit, 1, axis=1))
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    counts["shortest edge"] = float(length.min())
    counts["longest edge"] = float(length.max())
    counts["bounding box diagonal"] = float(
        np.linalg.norm(np.ptp(points[np.unique(faces)], axis=0))
    )
    counts["smallest angle"] = float(angle.min())
    counts["largest angle"] = float(angle.max())
    radians = np.radians(angle)
    cot = np.cos(radians) / np.maximum(np.sin(radians), 1e-300)
    # The angle at corner k is opposite to the edge from k + 1 to k + 2.
    opposite = np.sort(np.stack([np.roll(faces, -1, 1), np.roll(faces, -2, 1)], axis=2), axis=2)
    _, inverse = np.unique(opposite.reshape(-1, 2), axis=0, return_inverse=True)
    weight = np.bincount(inverse.ravel(), cot.ravel()) / 2
    report(
        int((weight < -1e-9).sum()),
        "edges have negative cotangent weights (obtuse angles)",
        "kept where the cells stay bounded, else set to 0 (see jd.rings)",
    )
    report(int((angle < 1.0).sum()), "angles are below 1 degree", "expect slower convergence there")
