"""Triangle meshes: reading, writing, checking, mending (thesis chapter 2)."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxdeform.formats import FORMATS, InputError, ply_columns, to_ply

# A triangle lower than this part of its longest edge has no area that float64 could tell from
# rounding; its cotangents would be noise. Thin but real ones (0.4 degrees) are 1e10 above it.
_FLAT = 1e-13


@dataclass(frozen=True, eq=False, init=False)
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

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Copy, check and freeze the arrays."""
        vertices, faces = _checked_arrays(vertices, faces)
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
    three corners are refused, because how to cut them is the modeller's choice. A file that holds
    less than it announces is refused; an OBJ announces nothing, unless :func:`save_mesh` (or
    MeshLab) wrote it.

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
    either kept whole or replaced whole. OBJ, OFF and PLY (binary) keep every bit; STL keeps single
    precision.

    **Arguments**

    - path: where to.
    - mesh: the mesh.
    - vertices: (n, 3) positions to write instead of the rest positions: another pose of it.
    - rigidity: a number or (n,), written as the vertex property ``rigidity`` (PLY only).

    **Raises** InputError: unknown suffix, a folder that cannot be written, wrong shapes, positions
    that are not finite.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=0.5)
        >>> jd.load_rigidity(path)[:2]
        array([0.5, 0.5])
    """
    path = Path(path)
    suffix = _suffix(path)
    points = np.asarray(mesh.vertices if vertices is None else vertices, np.float64)
    if points.shape != mesh.vertices.shape:
        raise InputError(
            f"vertices have shape {points.shape}, the mesh has {mesh.vertices.shape}: a pose needs "
            "one position per vertex"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"{path}: vertex {bad[0]} is {points[bad[0]].tolist()} ({bad.size} such): not written, "
            "since no program could read it"
        )
    if rigidity is not None:
        if suffix != ".ply":
            raise InputError(f"{path}: only PLY carries rigidity per vertex: use a .ply name")
        rigidity = np.asarray(rigidity, np.float64)
        if rigidity.shape not in ((), (mesh.n_vertices,)):
            raise InputError(
                f"rigidity has shape {rigidity.shape}: give one number or ({mesh.n_vertices},)"
            )
        content = to_ply(points, mesh.faces, rigidity)
    else:
        content = FORMATS[suffix].to_bytes(points, mesh.faces)
    write_beside(path, lambda name: Path(name).write_bytes(content))


def write_beside(path: Path, write: Callable[[str], object]) -> None:
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
        raise InputError(
            f"{path}: cannot write there ({error.strerror}): choose another name"
        ) from error
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
    check_place(path)


def check_place(path: Path) -> None:
    """Raise InputError if no file could be written there."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder: give the name of a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot write there: make the folder {path.parent} first")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: the folder {path.parent} cannot be written: choose another")


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
    columns, _ = ply_columns(path, _read_bytes(path))
    if "rigidity" not in columns:
        raise InputError(
            f"{path}: its vertices have no property 'rigidity' (only {', '.join(columns)}): write "
            "it with jd.save_mesh(..., rigidity=...)"
        )
    return columns["rigidity"]


def read_arrays(
    path: str | os.PathLike,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Read vertices and faces as they stand in the file, valid or not.

    Read here rather than by libigl, which crashes the process on a truncated OBJ, never returns
    from an empty OFF and drops half lines in silence. 50,000 vertices take 0.2 s.

    **Raises** InputError: missing, empty, truncated or unreadable file, unknown suffix, polygons.
    """
    path = Path(path)
    suffix = _suffix(path)
    vertices, faces = FORMATS[suffix].parse(path, _read_bytes(path))
    if not len(faces):
        raise InputError(f"{path}: holds no triangles: export it as a triangle mesh")
    if suffix == ".stl":
        vertices, merged = _merged(vertices)
        faces = merged[faces]
    return vertices, faces


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{path}: unknown suffix '{path.suffix}': use one of {', '.join(FORMATS)}")
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
    return data.removeprefix(b"\xef\xbb\xbf")


# ---------------------------------------------------------------- checks


def _checked_arrays(vertices: ArrayLike, faces: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return copies with valid shapes, finite vertices and indices in range, or raise."""
    try:
        points = np.array(vertices, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"vertices cannot be read as numbers: {error}") from error
    try:
        corners = np.array(faces, order="C")
    except ValueError as error:
        raise InputError(f"faces are no table of indices: {error}: give (m, 3)") from error
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
    # Scaled, first as a whole and then per face, so that no size leaves the range of float64.
    corner = (points / (np.abs(points).max() or 1.0))[faces]
    u, v, w = (corner[:, i] - corner[:, j] for i, j in ((1, 0), (2, 0), (2, 1)))
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


def _arrays(mesh: MeshLike) -> tuple[ArrayLike, ArrayLike]:
    if isinstance(mesh, Mesh):
        return mesh.vertices, mesh.faces
    if isinstance(mesh, str | os.PathLike):
        return read_arrays(mesh)
    try:
        vertices, faces = mesh
    except (TypeError, ValueError):
        raise InputError("give a Mesh, a pair (vertices, faces), or the path of a file") from None
    return vertices, faces


def _merged(points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct points in order of appearance, and for each old point its new index."""
    points = points + 0.0  # makes -0.0 equal to 0.0
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return points[first[order]], rank[inverse.ravel()]


# ---------------------------------------------------------------- mending and reporting


def repair(mesh: MeshLike) -> tuple[Mesh, Int[np.ndarray, "old"]]:
    """Merge equal vertices; drop degenerate and repeated faces and unreferenced vertices.

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
    points, merged = _merged(points)
    faces = merged[faces]
    faces = np.delete(faces, [face for _, face in _degenerate(points, faces)], axis=0)
    _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(keep)]
    if not len(faces):
        raise InputError("no face with an area is left after mending: the mesh is empty")
    used = np.unique(faces)
    new = np.full(len(points), -1)
    new[used] = np.arange(len(used))
    return Mesh(points[used], new[faces]), new[merged]


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
        shown = {k: str(v) if isinstance(v, int) else f"{v:g}" for k, v in self.counts.items()}
        lines = [f"{name:<{width}}  {value}" for name, value in shown.items()]
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
    sound = sound[np.unique(np.sort(sound, axis=1), axis=0, return_index=True)[1]]
    unreferenced = n - len(np.unique(faces))
    report(unreferenced, "vertices belong to no face", "they stay where they are")
    duplicates = n - len(np.unique(points, axis=0))
    report(duplicates, "vertices lie exactly on another", "the mesh is not joined there; jd.repair")
    repeated = m - len(np.unique(np.sort(faces, axis=1), axis=0))
    report(repeated, "faces are there twice", "their edges weigh double; jd.repair drops them")
    counts: dict[str, int | float] = {"vertices": n, "faces": m}
    if len(sound):
        _inspect_structure(points, sound, counts, report)
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
    report(
        int((_fans(faces, inverse.ravel()) > 1).sum()),
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


def _fans(faces: np.ndarray, edge: np.ndarray) -> Int[np.ndarray, "n"]:
    """Return for each vertex how many fans of faces meet there: faces joined by edges at it.

    edge numbers the undirected edges of each face: corners 0-1, 1-2, 2-0.
    """
    # Corners of one vertex are joined where their faces share an edge that ends there.
    corner = np.arange(faces.size).reshape(-1, 3)
    node = corner[:, [0, 1, 1, 2, 2, 0]].ravel()
    key = np.repeat(edge, 2) * (faces.max() + 1) + faces.ravel()[node]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    links = (node[order][:-1][same], node[order][1:][same])
    graph = sp.coo_matrix((np.ones(len(links[0])), links), shape=(faces.size,) * 2)
    _, label = sp.csgraph.connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    return np.bincount(faces.ravel()[first])


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
