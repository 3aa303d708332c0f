"""Cells: the edges that deform together with a vertex (thesis Sec. 2.3)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._arrays import read_host_array, read_integers, read_only
from jaxdeform._checks import check_type
from jaxdeform._errors import ArrayLike, InputError, a_or_an
from jaxdeform._mesh.laplacian import cotangent_weights
from jaxdeform._mesh.mesh import Mesh, content_digest


@dataclass(frozen=True, eq=False, init=False)
class Cells:
    """One cell per vertex: the edges that the transformation of this vertex has to fit.

    `rings` and `spokes` make them. Like the mesh, cells are a value: equal content makes them
    equal, in every process. The arrays are read-only: copy one before you change it.

    **Arguments**, which are also the fields

    - mesh: the rest shape that the cells belong to.
    - weights: (edges,) one finite weight per row of ``mesh.edges``.
    - membership: (vertices, edges), sparse: 1 where the edge belongs to the cell of the vertex.

    **Raises** InputError: the weights are not finite or of the wrong length; the membership is not
    sparse, of the wrong shape, or holds other numbers than 0 and 1.
    """

    mesh: Mesh
    weights: Float[np.ndarray, "edges"]
    membership: sp.csr_matrix

    def __init__(self, mesh: Mesh, weights: ArrayLike, membership: Any) -> None:
        """Check, copy and freeze the arrays."""
        check_type("mesh", mesh, Mesh)
        member = _read_membership(mesh, membership)
        for array in (member.data, member.indices, member.indptr):
            read_only(array)
        object.__setattr__(self, "mesh", mesh)
        object.__setattr__(self, "weights", read_only(_read_weights(mesh, weights)))
        object.__setattr__(self, "membership", member)

    def __reduce__(self):
        """Pickle the content; loading checks and freezes it again."""
        return Cells, (self.mesh, self.weights, self.membership)

    @property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Undirected edges (i < j) of the mesh, each once."""
        return self.mesh.edges

    @property
    def n_vertices(self) -> int:
        """Number of vertices, which is also the number of cells."""
        return self.mesh.n_vertices

    @cached_property
    def digest(self) -> bytes:
        """A fingerprint of the content: the same for equal cells, in every process."""
        member = self.membership
        mesh = np.frombuffer(self.mesh.digest, np.uint8)
        return content_digest(mesh, self.weights, member.indptr, member.indices, member.data)

    def __eq__(self, other: object) -> bool:
        """Return whether the other cells have the same mesh, weights and membership."""
        return self is other or (isinstance(other, Cells) and self.digest == other.digest)

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return hash(self.digest)

    @property
    def overlap(self) -> Int[np.ndarray, "edges"]:
        """The number of cells that contain each edge: d_e of Eq. 4.5."""
        return np.bincount(self.membership.indices, minlength=len(self.edges))

    @property
    def reach(self) -> sp.csr_matrix:
        """(cells, vertices): nonzero at the ends of the edges of a cell and at its centre."""
        count, n = len(self.edges), self.n_vertices
        rows = np.repeat(np.arange(count), 2)
        ends = sp.csr_matrix((np.ones(2 * count, np.int32), (rows, self.edges.ravel())), (count, n))
        inside = self.membership.astype(np.int32) @ ends
        return sp.csr_matrix(inside + sp.eye_array(n).astype(np.int32))

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        mean = self.membership.nnz / max(self.n_vertices, 1)
        return f"Cells({self.n_vertices} cells, {len(self.edges)} edges, {mean:.1f} edges per cell)"


def rings(mesh: Mesh, r: ArrayLike = 1, *, weights: ArrayLike | None = None) -> Cells:
    """Return the r-ring cells: ``E(k, r)`` holds the edges with both ends within r steps of k.

    A cell with ``r = 1`` includes the edges of its rim, so it is not the neighbourhood of ARAP; see
    `spokes` for that. Thesis Sec. 2.3, after Chen, Gao, Lai and Xia, "Rigidity controllable
    as-rigid-as-possible shape deformation" (2017).

    **Arguments**

    - mesh: the rest shape.
    - r: an integer >= 1, or one per vertex, (vertices,).
    - weights: (edges,), one finite weight per row of ``mesh.edges``. By default, cotangent weights.
      Negative ones (obtuse angles) count as 0 in the few cells whose energy they leave without a
      lower bound; `precompute` names those.

    **Returns** `Cells`.

    **Raises** InputError: r is below 1, not an integer, or of the wrong length; the weights are not
    finite or of the wrong length.

    Example:
        >>> import jaxdeform as jd
        >>> jd.rings(jd.shapes.bar(), 2)
        Cells(722 cells, 2160 edges, 41.8 edges per cell)
    """
    check_type("mesh", mesh, Mesh)
    n = mesh.n_vertices
    radius = read_integers(r, "r", "give one integer, or one per vertex, such as 1")
    if radius.ndim > 0 and radius.shape != (n,):
        raise InputError(
            f"r has shape {radius.shape}, but the mesh has {n} vertices: give one integer or ({n},)"
        )
    radius = np.broadcast_to(radius, (n,))
    if radius.min() < 1:
        k = int(radius.argmin())
        raise InputError(
            f"r = {radius[k]} at vertex {k}: give 1 or more, or use spokes(mesh) for ARAP"
        )

    incidence = _incidence(mesh)
    # Booleans, because counts of paths would overflow: in eight bits, 256 paths count as 0.
    ends_at = incidence.astype(bool)
    step = sp.csr_matrix(ends_at @ ends_at.T + sp.eye_array(n).astype(bool))
    reach = step
    for ring in range(2, int(radius.max()) + 1):
        growing = sp.csr_matrix(sp.diags_array(radius >= ring, dtype=bool) @ reach)
        growing.eliminate_zeros()
        wider = sp.csr_matrix(reach + growing @ step)
        if wider.nnz == reach.nnz:
            break  # every cell already covers its connected component
        reach = wider
    # A cell reaches none, one or both ends of an edge. The edge is a member if it reaches both.
    ends = sp.csr_matrix(reach.astype(np.int8) @ incidence)
    ends.data = (ends.data == 2).astype(np.int8)
    ends.eliminate_zeros()
    ends.sort_indices()
    return Cells(mesh, cotangent_weights(mesh) if weights is None else weights, ends)


def spokes(mesh: Mesh, *, weights: ArrayLike | None = None) -> Cells:
    """Return the cells of plain ARAP: the edges that meet at the vertex (Eq. 3.3).

    Sorkine and Alexa, "As-rigid-as-possible surface modeling" (2007),
    doi:10.2312/SGP/SGP07/109-116.

    **Arguments**

    - mesh: the rest shape.
    - weights: (edges,), as in `rings`. A negative weight leaves nearly every star without a
      lower bound. So, as in CGAL and unlike in libigl, negative weights count as 0 with spokes.

    **Returns** `Cells`.

    **Raises** InputError: the weights are not finite or of the wrong length.

    Example:
        >>> import jaxdeform as jd
        >>> jd.spokes(jd.shapes.bar())
        Cells(722 cells, 2160 edges, 6.0 edges per cell)
    """
    check_type("mesh", mesh, Mesh)
    given = cotangent_weights(mesh) if weights is None else weights
    return Cells(mesh, given, _incidence(mesh))


def principal_moments(
    cells: Cells,
) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices 3 3"]]:
    """Return the principal moments b (ascending) and axes Q of each cell.

    ``B_k = sum_e w_e e e^T = Q_k diag(b_k) Q_k^T``, in units of length squared. The columns of Q_k
    are the principal axes of cell k; Q_k is a proper rotation.
    """
    i, j = cells.edges.T
    edge = cells.mesh.vertices[i] - cells.mesh.vertices[j]
    outer = cells.weights[:, None, None] * edge[:, :, None] * edge[:, None, :]
    moments = (cells.membership.astype(np.float64) @ outer.reshape(-1, 9)).reshape(-1, 3, 3)
    values, axes = np.linalg.eigh(moments)
    # If Q were a reflection, the proper rotation of a cell would become an improper one.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return values, axes


def _incidence(mesh: Mesh) -> sp.csr_matrix:
    """Return (vertices, edges): 1 where the vertex is an end of the edge."""
    count = len(mesh.edges)
    columns = np.repeat(np.arange(count, dtype=np.int32), 2)
    matrix = sp.csr_matrix(
        (np.ones(2 * count, np.int8), (mesh.edges.ravel(), columns)),
        shape=(mesh.n_vertices, count),
    )
    matrix.sort_indices()
    return matrix


def _read_weights(mesh: Mesh, weights: ArrayLike) -> Float[np.ndarray, "edges"]:
    """Return a copy of the weights, or raise InputError."""
    given = read_host_array(weights, np.float64, "weights")
    if given.shape != (len(mesh.edges),):
        raise InputError(
            f"weights have shape {given.shape}: give one per row of mesh.edges, "
            f"({len(mesh.edges)},)"
        )
    if not np.isfinite(given).all():
        bad = int(np.flatnonzero(~np.isfinite(given))[0])
        raise InputError(f"the weight of edge {bad} is {given[bad]}: weights must be finite")
    return given.copy()


def _read_membership(mesh: Mesh, membership: Any) -> sp.csr_matrix:
    """Return a copy with ones in ascending order, or raise InputError."""
    if not sp.issparse(membership):
        raise InputError(
            f"membership is {a_or_an(membership)}: give a sparse matrix of SciPy, as "
            "jd.rings(mesh).membership"
        )
    shape = mesh.n_vertices, len(mesh.edges)
    if membership.shape != shape:
        raise InputError(
            f"membership has shape {membership.shape}: give (vertices, edges), {shape}"
        )
    member = sp.csr_matrix(membership, copy=True)
    member.sum_duplicates()
    member.eliminate_zeros()
    if not (member.data == 1).all():
        vertex = int(np.searchsorted(member.indptr, np.argmax(member.data != 1), "right")) - 1
        raise InputError(
            f"the membership of cell {vertex} holds {member.data[member.data != 1][0]}: give 1 "
            "where the edge belongs to the cell, and nothing elsewhere"
        )
    return sp.csr_matrix(member, dtype=np.int8)
