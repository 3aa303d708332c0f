"""Cells: which edges move together with a vertex (thesis Sec. 2.3)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._mesh.laplacian import cotangent_weights
from jaxdeform._mesh.mesh import Mesh, content_digest
from jaxdeform.errors import ArrayLike, InputError


@dataclass(frozen=True, eq=False)
class Cells:
    """One cell per vertex: the edges whose deformation its transformation must explain.

    Made by :func:`rings` and :func:`spokes`. Cells are a value, as the mesh is.
    """

    mesh: Mesh
    """The rest shape that the cells belong to."""
    weights: Float[np.ndarray, "edges"]
    """One weight per row of ``mesh.edges``; cotangents unless the caller gave others."""
    membership: sp.csr_matrix
    """(vertices, edges), 1 where the edge belongs to the vertex's cell."""

    @property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Undirected edges (i < j) of the mesh, each once."""
        return self.mesh.edges

    @property
    def n_vertices(self) -> int:
        """Number of cells, which is the number of vertices."""
        return self.mesh.n_vertices

    @cached_property
    def digest(self) -> bytes:
        """Fingerprint of the content: equal for equal cells, in any process."""
        member = self.membership
        mesh = np.frombuffer(self.mesh.digest, np.uint8)
        return content_digest(mesh, self.weights, member.indptr, member.indices, member.data)

    def __eq__(self, other: object) -> bool:
        """Return whether the other cells have the same mesh, weights and members."""
        return self is other or (isinstance(other, Cells) and self.digest == other.digest)

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return hash(self.digest)

    @property
    def overlap(self) -> Int[np.ndarray, "edges"]:
        """d_e of Eq. 4.5: the number of cells that contain each edge."""
        return np.bincount(self.membership.indices, minlength=len(self.edges))

    @property
    def reach(self) -> sp.csr_matrix:
        """(cells, vertices), nonzero where an edge of the cell ends, and at its centre."""
        count, n = len(self.edges), self.n_vertices
        rows = np.repeat(np.arange(count), 2)
        ends = sp.csr_matrix((np.ones(2 * count, np.int32), (rows, self.edges.ravel())), (count, n))
        inside = self.membership.astype(np.int32) @ ends
        return sp.csr_matrix(inside + sp.eye_array(n).astype(np.int32))

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        mean = self.membership.nnz / max(self.n_vertices, 1)
        return f"Cells({self.n_vertices} cells, {len(self.edges)} edges, {mean:.1f} edges a cell)"


def rings(mesh: Mesh, r: ArrayLike = 1, *, weights: ArrayLike | None = None) -> Cells:
    """Return the r-ring cells: ``E(k, r)`` holds the edges with both ends within r steps of k.

    ``r = 1`` therefore has the rim edges too and is not the neighbourhood of ARAP; for that see
    :func:`spokes`. Thesis Sec. 2.3; RC-ARAP (Chen et al. 2017).

    **Arguments**

    - mesh: the rest shape.
    - r: an integer >= 1, or one per vertex, (vertices,).
    - weights: one finite weight per row of ``mesh.edges``, used as they are. The default is
      cotangent weights. Their negative ones (obtuse angles) are kept, except in cells whose moments
      ``B_k = sum w e e^T`` they make indefinite. There they are set to 0, because such a cell would
      gain energy from stretching. Few meshes have such cells.

    **Raises** InputError: r below 1, not an integer, or of the wrong length; weights likewise.

    Example:
        >>> import jaxdeform as jd
        >>> jd.rings(jd.shapes.bar(), 2)
        Cells(722 cells, 2160 edges, 41.8 edges a cell)
    """
    n = mesh.n_vertices
    radius = np.asarray(r)
    if radius.dtype.kind not in "iu":
        raise InputError(f"r must be an integer or one per vertex, got {radius.dtype}: use 1 or 2")
    if radius.ndim > 0 and radius.shape != (n,):
        raise InputError(
            f"r has shape {radius.shape}, the mesh {n} vertices: give one integer, or ({n},)"
        )
    radius = np.broadcast_to(radius, (n,))
    if radius.min() < 1:
        k = int(radius.argmin())
        raise InputError(
            f"r = {radius[k]} at vertex {k}: a ring needs r >= 1 (spokes(mesh) for ARAP's cells)"
        )

    incidence = _incidence(mesh)
    # As booleans: counts of paths would overflow (256 of them are 0 in eight bits).
    ends_at = incidence.astype(bool)
    step = sp.csr_matrix(ends_at @ ends_at.T + sp.eye_array(n).astype(bool))
    reach = step
    for ring in range(2, int(radius.max()) + 1):
        growing = sp.csr_matrix(sp.diags_array(radius >= ring, dtype=bool) @ reach)
        growing.eliminate_zeros()
        wider = sp.csr_matrix(reach + growing @ step)
        if wider.nnz == reach.nnz:
            break  # every cell is all of its part already
        reach = wider
    # Of an edge's two ends, a cell reaches none, one or both: both make it a member.
    ends = sp.csr_matrix(reach.astype(np.int8) @ incidence)
    ends.data = (ends.data == 2).astype(np.int8)
    ends.eliminate_zeros()
    ends.sort_indices()
    chosen = _weights(mesh, weights)
    if weights is None:
        chosen = _bounded(mesh, ends, chosen)
    return Cells(mesh, chosen, ends)


def spokes(mesh: Mesh, *, weights: ArrayLike | None = None) -> Cells:
    """Return the cells of plain ARAP: the edges that meet at the vertex (Eq. 3.3).

    **Arguments**: mesh; weights as in :func:`rings`, but cotangent weights are left as they are,
    as in every ARAP program: rotations do not need B. With a material on an obtuse mesh, prefer
    rings or pass weights without negative ones. **Raises** InputError as there.

    Example:
        >>> import jaxdeform as jd
        >>> jd.spokes(jd.shapes.bar())
        Cells(722 cells, 2160 edges, 6.0 edges a cell)
    """
    return Cells(mesh, _weights(mesh, weights), _incidence(mesh))


def principal_moments(
    cells: Cells,
) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices 3 3"]]:
    """Return the moments b (ascending) and the axes Q of ``B_k = sum_e w_e e e^T = Q diag(b) Q^T``.

    The columns of ``Q_k`` are the principal axes of cell k, a proper rotation.
    """
    i, j = cells.edges.T
    edge = cells.mesh.vertices[i] - cells.mesh.vertices[j]
    outer = cells.weights[:, None, None] * edge[:, :, None] * edge[:, None, :]
    moments = (cells.membership.astype(np.float64) @ outer.reshape(-1, 9)).reshape(-1, 3, 3)
    values, axes = np.linalg.eigh(moments)
    # A reflection would turn the proper rotation of a cell into an improper one.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return values, axes


def indefinite_cells(cells: Cells) -> Int[np.ndarray, "bad"]:
    """Return the cells with a clearly negative moment."""
    moments, _ = principal_moments(cells)
    return np.flatnonzero(moments[:, 0] < -1e-9 * np.abs(moments).max(axis=1))


def _bounded(
    mesh: Mesh, membership: sp.csr_matrix, weights: Float[np.ndarray, "edges"]
) -> Float[np.ndarray, "edges"]:
    """Set the negative weights in indefinite cells to 0; raising a weight harms no other cell."""
    if (weights >= 0).all():
        return weights
    bad = indefinite_cells(Cells(mesh, weights, membership))
    touched = np.unique(membership[bad].indices)
    out = weights.copy()
    out[touched] = np.maximum(out[touched], 0.0)
    return out


def _incidence(mesh: Mesh) -> sp.csr_matrix:
    """Return (vertices, edges), 1 where the vertex is an end of the edge."""
    count = len(mesh.edges)
    columns = np.repeat(np.arange(count, dtype=np.int32), 2)
    matrix = sp.csr_matrix(
        (np.ones(2 * count, np.int8), (mesh.edges.ravel(), columns)),
        shape=(mesh.n_vertices, count),
    )
    matrix.sort_indices()
    return matrix


def _weights(mesh: Mesh, weights: ArrayLike | None) -> Float[np.ndarray, "edges"]:
    if weights is None:
        return cotangent_weights(mesh)
    given = np.asarray(weights, dtype=np.float64)
    if given.shape != (len(mesh.edges),):
        raise InputError(
            f"weights have shape {given.shape}: give one per row of mesh.edges, "
            f"({len(mesh.edges)},)"
        )
    if not np.isfinite(given).all():
        bad = int(np.flatnonzero(~np.isfinite(given))[0])
        raise InputError(f"the weight of edge {bad} is {given[bad]}: weights must be finite")
    return given
