"""The linear maps of Eq. 4.4 and 4.5: K of ``C = K p'``, its transpose, and A.

Principal axes. ``B_k = Q_k diag(b_k) Q_k^T`` is constant, so each cell is written in its own
principal axes once and for all: K is stored as ``Q_k^T C_k``, and ``T_k Q_k`` is solved for. In
these axes B is diagonal, which makes the Hessian of the local step nearly block diagonal.

The layout is that of ell.py: the vertex (or cell) is the last axis, and a batch inside it.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from jaxdeform._linalg.ell import EllMatrix, multiply, split_batch
from jaxdeform._mesh.cells import Cells
from jaxdeform._mesh.laplacian import difference_matrix


class CovarianceMap(eqx.Module):
    """K in the cells' principal axes, and its transpose: ``C_k = Q_k^T sum_e w_e e e'^T``.

    Derivatives to the numbers of K are attributed to the matrix that was multiplied with:
    ``forward`` for C, ``backward`` for K^T T. Where both are functions of something else, the
    derivatives to that are complete.
    """

    forward: EllMatrix
    """K: three blocks below each other, one per rest axis."""
    backward: EllMatrix
    """K^T: three blocks beside each other."""

    @staticmethod
    def of(blocks: list[sp.csr_matrix], dtype: np.dtype) -> "CovarianceMap":
        """Return K, given a block per axis."""
        return CovarianceMap(
            EllMatrix.build([[block] for block in blocks], dtype),
            EllMatrix.build([[block.T.tocsr() for block in blocks]], dtype),
        )

    def __call__(self, positions: Float[Array, "3 v"], batch: int = 1) -> Float[Array, "3 3 v"]:
        """Return C (rest axis, deformed axis, cell)."""
        x = split_batch(positions, batch)[:, None]
        out = multiply(self.forward, self.backward, x)
        return jnp.swapaxes(out.reshape(3, 3, -1), 0, 1)

    def transpose(self, transforms: Float[Array, "3 3 v"], batch: int = 1) -> Float[Array, "3 v"]:
        """Return K^T T, the right-hand side of Eq. 4.5, for T (deformed axis, rest axis, cell)."""
        out = multiply(self.backward, self.forward, split_batch(transforms, batch))
        return out.reshape(3, -1)


def covariance_blocks(
    cells: Cells,
    vertices: Float[np.ndarray, "vertices 3"],
    principal_axes: Float[np.ndarray, "vertices 3 3"],
    size: int,
) -> list[sp.csr_matrix]:
    """Return K, a block per axis, for cells on these rest vertices in their principal axes.

    The axes are columns. Empty cells fill the blocks up to a size (buckets.py).
    """
    (i, j), member = cells.edges.T, cells.membership
    pull = cells.weights[:, None] * (vertices[i] - vertices[j])
    # For each edge of each cell, its two ends: +pull and -pull.
    cell, edge = np.repeat(np.arange(cells.n_vertices), np.diff(member.indptr)), member.indices
    share = np.einsum("eac,ea->ce", principal_axes[cell], pull[edge] * member.data[:, None])
    rows, columns = np.tile(cell, 2), np.concatenate([i[edge], j[edge]])
    return [
        sp.csr_matrix((np.concatenate([x, -x]), (rows, columns)), shape=(size, size)) for x in share
    ]


def stiffness(cells: Cells) -> sp.csc_matrix:
    """Return A of Eq. 4.5: the Laplacian whose edges weigh ``d_e w_e``."""
    difference = difference_matrix(cells.edges, cells.n_vertices)
    return (difference.T @ sp.diags(cells.overlap * cells.weights) @ difference).tocsc()
