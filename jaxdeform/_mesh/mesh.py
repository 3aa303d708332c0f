"""Triangle meshes: checked once, then frozen (thesis chapter 2)."""

import hashlib
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from jaxdeform._arrays import read_host_array, read_integers, read_only
from jaxdeform._checks import check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.grouping import distinct
from jaxdeform._mesh.parsed import Source

# A triangle has no area if its height is below this fraction of its longest edge: float64 cannot
# tell such an area from rounding, and the cotangents would be noise. Thin but real triangles
# (0.4 degrees) lie a factor of 1e10 above it.
_FLAT = 1e-13

NO_AREA = "has no area"

# Energies are squares of lengths, to be known to 16 digits: beyond this length, and below its
# inverse, they leave the range of float64.
LARGEST = 1e140


@dataclass(frozen=True, eq=False, init=False)
class Mesh:
    """A triangle mesh, checked once when it is made, then frozen.

    Open borders, several connected components, unreferenced vertices, non-manifold edges and
    vertices, inward-facing faces, and faces without area are all allowed; `inspect` reports
    them. A face without area is kept for files and pictures, but its edges weigh nothing, as in
    other ARAP programs: a vertex that has no other face stays where it is.

    A mesh is a value. Two meshes with the same numbers are equal and have the same hash, even after
    pickling or in another process. The arrays are read-only: copy one before you change it. Some
    compiled functions take no read-only arrays even to read them, such as ``apply`` of SciPy's
    ``Rotation``: give them a copy, ``rotation.apply(mesh.vertices.copy())``.

    **Arguments**

    - vertices: (vertices, 3), in any unit of length.
    - faces: (faces, 3), vertex indices, counter-clockwise seen from outside.
    - source: what `load_mesh` remembers of a file with these faces, for `save_mesh`.

    **Fields**

    - vertices, faces: as given, but read-only.
    - solid_faces: (solid, 3) the faces that have an area. Only these have edges, and so a part in
      the energy.
    - source: the file that the mesh was read from, so that it can be written with other positions.
      It is pickled with the mesh, but meshes with the same numbers are equal whatever file they are
      from: it changes no result.

    **Raises** InputError: an array is empty, has the wrong shape or is traced by JAX (see
    ``deform(rest=)`` for derivatives to the rest shape); a vertex is not finite; a face index is
    out of range; a face repeats a vertex, or none has an area (`repair`); lengths above 1e140 or
    below 1e-140; the source has other faces.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        Mesh(3 vertices, 1 faces)
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    solid_faces: Int[np.ndarray, "solid 3"]
    source: Source | None

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, *, source: Source | None = None
    ) -> None:
        """Copy, check and freeze the arrays."""
        vertices, faces = checked_arrays(vertices, faces)
        if source is not None:
            check_type("source", source, Source)
            if not source.fits(len(vertices), faces):
                raise InputError(
                    "source is of a mesh with other faces: leave it out, and the file will be new"
                )
        bad = degenerate_faces(vertices, faces)
        for reason, face in bad:
            if reason != NO_AREA or len(bad) == len(faces):
                raise InputError(
                    f"face {face} {faces[face].tolist()} {reason}: drop such faces with "
                    "jd.repair((vertices, faces))"
                )
        solid = np.delete(faces, [face for _, face in bad], axis=0) if bad else faces
        for name, array in (("vertices", vertices), ("faces", faces), ("solid_faces", solid)):
            object.__setattr__(self, name, read_only(array))
        object.__setattr__(self, "source", source)

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
        """Undirected edges (i < j) of faces with an area, each once, in ascending order."""
        return read_only(unique_edges(self.solid_faces))

    @cached_property
    def referenced(self) -> Bool[np.ndarray, "vertices"]:
        """True for each vertex that belongs to a face with an area."""
        mask = np.zeros(self.n_vertices, bool)
        mask[self.solid_faces.ravel()] = True
        return read_only(mask)

    @cached_property
    def components(self) -> Int[np.ndarray, "vertices"]:
        """Connected component of each vertex, numbered from 0."""
        return read_only(connected_components(self.edges, self.n_vertices))

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box of the referenced vertices."""
        return float(np.linalg.norm(np.ptp(self.vertices[self.referenced], axis=0)))

    @cached_property
    def center(self) -> Float[np.ndarray, "3"]:
        """Mean of the referenced vertices."""
        return read_only(self.vertices[self.referenced].mean(axis=0))

    @cached_property
    def digest(self) -> bytes:
        """A fingerprint of the content: the same for equal meshes, in every process."""
        return content_digest(self.vertices, self.faces)

    def __eq__(self, other: object) -> bool:
        """Return whether the other mesh has the same numbers."""
        return self is other or (isinstance(other, Mesh) and self.digest == other.digest)

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return hash(self.digest)

    def __reduce__(self):
        """Pickle the arrays and the source; loading checks and freezes the arrays again."""
        return partial(Mesh, source=self.source), (self.vertices, self.faces)

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        return f"Mesh({self.n_vertices} vertices, {self.n_faces} faces)"


def checked_arrays(vertices: ArrayLike, faces: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return copies of valid shape, with finite vertices and indices in range, or raise."""
    points = np.array(read_host_array(vertices, np.float64, "vertices"), order="C")
    corners = np.array(read_integers(faces, "faces"), order="C")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(
            f"vertices have shape {points.shape}: give (vertices, 3), at least one vertex"
        )
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) == 0:
        raise InputError(
            f"faces have shape {corners.shape}: give (faces, 3) triangles, at least one"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"vertex {bad[0]} is {points[bad[0]].tolist()} ({bad.size} in total): give finite "
            "positions"
        )
    bad = np.flatnonzero(((corners < 0) | (corners >= len(points))).any(axis=1))
    if bad.size:
        raise InputError(
            f"face {bad[0]} {corners[bad[0]].tolist()} names a vertex out of range: vertices "
            f"are 0 to {len(points) - 1}"
        )
    _check_scale(points, corners)
    return points, corners


def _check_scale(points: np.ndarray, corners: np.ndarray) -> None:
    """Raise InputError where squares of lengths would leave the range of float64."""
    far = np.abs(points).max(axis=1)
    if far.max() > LARGEST:
        k = int(far.argmax())
        raise InputError(
            f"vertex {k} is {points[k].tolist()}: squares of lengths above {LARGEST:g} leave the "
            "range of float64; give the vertices in a larger unit of length"
        )
    size = np.ptp(points[corners.ravel()], axis=0).max()
    if 0 < size < 1 / LARGEST:
        raise InputError(
            f"the mesh is {size:.3g} long: squares of lengths below {1 / LARGEST:g} leave the "
            "range of float64; give the vertices in a smaller unit of length"
        )


def degenerate_faces(points: np.ndarray, faces: np.ndarray) -> list[tuple[str, int]]:
    """Return (reason, face) for each face that repeats a vertex or has no area."""
    repeats = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    found = [("repeats a vertex", int(k)) for k in np.flatnonzero(repeats)]
    # Scale the mesh as a whole, then each face, so that no number leaves the range of float64.
    corner = (points / (np.abs(points).max() or 1.0))[faces]
    u, v, w = (corner[:, i] - corner[:, j] for i, j in ((1, 0), (2, 0), (2, 1)))
    longest = np.abs(np.concatenate([u, v, w], axis=1)).max(axis=1)
    size = np.where(longest > 0, longest, 1.0)[:, None]
    area = np.linalg.norm(np.cross(u / size, v / size), axis=1)
    flat = (area <= _FLAT) & ~repeats
    return found + [(NO_AREA, int(k)) for k in np.flatnonzero(flat)]


def unique_edges(faces: np.ndarray) -> Int[np.ndarray, "edges 2"]:
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    # Encode each pair as one number, because np.unique over rows is ten times slower.
    n = int(faces.max()) + 1
    code = distinct(pairs[:, 0] * n + pairs[:, 1])
    return np.stack([code // n, code % n], axis=1)


def connected_components(
    edges: Int[np.ndarray, "edges 2"], n_vertices: int
) -> Int[np.ndarray, "vertices"]:
    """Return the connected component of each vertex, numbered from 0."""
    links = (np.ones(len(edges), np.int8), tuple(edges.T))
    graph = sp.coo_matrix(links, shape=(n_vertices, n_vertices))
    return sp.csgraph.connected_components(graph, directed=False)[1]


def content_digest(*arrays: np.ndarray) -> bytes:
    """Return a 128-bit fingerprint of the shapes, dtypes and numbers of some arrays."""
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(f"{array.shape} {array.dtype.str}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def merge_equal_points(points: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct points in order of appearance, and the new index of each old point."""
    points = points + 0.0  # turns -0.0 into 0.0
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return points[first[order]], rank[inverse.ravel()]
