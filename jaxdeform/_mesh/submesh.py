"""Deform a piece of a mesh: cut it out, deform it, put it back (thesis Sec. 4.1.4)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._arrays import read_only
from jaxdeform._checks import check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.cells import Cells, rings
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.selection import read_mask
from jaxdeform._values import read_host_positions


@dataclass(frozen=True, eq=False)
class Submesh:
    """A piece of a mesh around the free vertices; made by `submesh`.

    **Fields**

    - mesh: the piece, as a mesh of its own.
    - cells: the cells of the whole mesh that contain a free vertex; the other cells are empty.
    - handles: (handles,) the vertices of the piece that are not free, by their index in the piece.
    - index: (piece,) the index in the whole mesh of each vertex of the piece.
    - whole: the mesh that the piece was cut from.
    """

    mesh: Mesh
    cells: Cells
    handles: Int[np.ndarray, "handles"]
    index: Int[np.ndarray, "piece"]
    whole: Mesh

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for name in ("handles", "index"):
            object.__setattr__(self, name, read_only(np.array(getattr(self, name))))

    def __reduce__(self):
        """Pickle the content; loading freezes it again."""
        return Submesh, (self.mesh, self.cells, self.handles, self.index, self.whole)

    def reinsert(
        self, vertices: ArrayLike, base: ArrayLike | None = None
    ) -> Float[np.ndarray, "vertices 3"]:
        """Return the positions of the whole mesh, with the piece put back.

        **Arguments**

        - vertices: (piece, 3), the deformed piece.
        - base: (vertices, 3), positions for all other vertices; by default their rest positions.

        **Returns** (vertices, 3).

        **Raises** InputError: a shape is wrong; a position is not finite.
        """
        piece = read_host_positions("vertices", vertices, (len(self.index), 3))
        whole = self.whole.vertices
        out = whole if base is None else read_host_positions("base", base, whole.shape)
        out = np.array(out)
        out[self.index] = piece
        return out


def submesh(mesh: Mesh, free: ArrayLike, cells: Cells | None = None) -> Submesh:
    """Cut out the cells that contain a free vertex, and nothing else.

    A cell whose vertices are all fixed has a fixed transformation, so it can be left out: the piece
    deforms exactly as it would within the whole mesh (up to rounding). Handles of the whole mesh
    that are not in the piece touch none of its cells, so they play no part: give targets to
    ``handles`` of the piece, in its own numbers.

    **Arguments**

    - mesh: the whole mesh.
    - free: the vertices that may move: indices, a mask (vertices,) or a selection.
    - cells: the cells of the whole mesh; by default ``rings(mesh, 1)``.

    **Returns** a `Submesh`.

    **Raises** InputError: no vertex is free; an index is out of range; the cells are of another
    mesh.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> piece = jd.submesh(mesh, mesh.vertices[:, 1] > 120)
        >>> problem = jd.precompute(piece.mesh, piece.handles, cells=piece.cells)
        >>> out = jd.deform(problem, piece.mesh.vertices[piece.handles], 1.0)
        >>> piece.reinsert(out.vertices).shape
        (722, 3)
    """
    check_type("mesh", mesh, Mesh)
    cells = rings(mesh, 1) if cells is None else cells
    check_type("cells", cells, Cells)
    if cells.mesh != mesh:
        raise InputError("cells are of another mesh: call rings(mesh, r) for this one")
    is_free = read_mask("free", free, mesh, "free vertex")
    if not is_free.any():
        raise InputError("no vertex is free, so nothing can deform: give at least one")
    # The vertices of each cell, including its centre.
    reach = cells.reach
    moving = np.asarray((reach @ is_free.astype(np.int32)) > 0).ravel()
    kept = np.unique(reach[moving].indices)
    index = np.union1d(kept, np.flatnonzero(is_free))
    new = np.full(mesh.n_vertices, -1)
    new[index] = np.arange(len(index))
    faces = new[mesh.solid_faces]
    faces = faces[(faces >= 0).all(axis=1)]
    if not len(faces):
        raise InputError("the free vertices belong to no face: free a vertex that does")
    piece = Mesh(mesh.vertices[index], faces)

    # Find the edges of the piece among those of the whole. Both lists are sorted, and renumbering
    # keeps the order.
    n = mesh.n_vertices
    whole_code = cells.edges[:, 0] * n + cells.edges[:, 1]
    piece_code = index[piece.edges[:, 0]] * n + index[piece.edges[:, 1]]
    edge = np.searchsorted(whole_code, piece_code)
    membership = cells.membership.copy()
    membership.data = membership.data * np.repeat(moving, np.diff(membership.indptr)).astype(
        np.int8
    )
    membership.eliminate_zeros()
    piece_cells = Cells(piece, cells.weights[edge], membership[index][:, edge].tocsr())
    held = np.flatnonzero(~is_free[index])
    return Submesh(piece, piece_cells, held, index, mesh)
