"""The first guess: Laplacian editing of the rest shape (thesis Sec. 4.1.2)."""

import equinox as eqx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float

from jaxdeform._mesh.cells import Cells
from jaxdeform._mesh.laplacian import graph_laplacian
from jaxdeform.energy import Rows
from jaxdeform.global_step import Factor, HostFactor, factorise


class LaplacianStart(eqx.Module):
    """``argmin |L p' - L p|`` under hard handles (Sec. 4.1.2), as a map of the handles' motion.

    With u = p' - p the normal equations are ``(L^T L)_ff u_f = -(L^T L)_fh u_h``.
    """

    normal: Rows
    factor: Factor

    def __call__(self, motion: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
        """Return the motion of all vertices, given that of the fixed ones (zero at free ones)."""
        return motion - self.factor.solve(self.normal.apply(motion))


def laplacian_start(
    cells: Cells, free: Bool[np.ndarray, "n"], dtype: np.dtype
) -> tuple[LaplacianStart, HostFactor | None]:
    """Set up the normal equations, and what keeps a large factor (made at first use) alive."""
    laplacian = normalised_laplacian(cells)
    normal = (laplacian.T @ laplacian).tocsr()
    factor, held = factorise(normal, free, dtype)
    return LaplacianStart(Rows.build([normal], dtype), factor), held


def normalised_laplacian(cells: Cells) -> sp.csr_matrix:
    """Return L of Eq. 3.1: each row of the Laplacian divided by its vertex's sum of weights.

    A sum that negative weights bring near zero is kept away from it, by its absolute parts.
    """
    n = cells.n_vertices
    laplacian = graph_laplacian(cells.edges, cells.weights, n)
    size = np.zeros(n)
    for end in cells.edges.T:
        np.add.at(size, end, np.abs(cells.weights))
    total = np.maximum(laplacian.diagonal(), 1e-2 * size)
    return sp.csr_matrix(sp.diags(1.0 / np.where(total > 0, total, 1.0)) @ laplacian)
