"""The first guess: Laplacian editing of the rest shape (thesis Sec. 4.1.2)."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdeform._linalg.buckets import enlarge
from jaxdeform._linalg.cholesky import Factor, factorise
from jaxdeform._linalg.ell import WIDTHS, EllMatrix
from jaxdeform._mesh.cells import Cells
from jaxdeform._mesh.laplacian import normalised_laplacian


class LaplacianGuess(eqx.Module):
    """``argmin |L p' - L p|`` under hard handles, as a linear map of the handles' displacement.

    With u = p' - p the normal equations are ``(L^T L)_ff u_f = -(L^T L)_fh u_h``.
    """

    normal: EllMatrix
    """L^T L."""
    factor: Factor

    def __call__(self, displacement: Float[Array, "3 vertices"]) -> Float[Array, "3 vertices"]:
        """Return the displacement of all vertices, given that of the handles (0 elsewhere)."""
        return displacement - self.factor.solve(self.normal.apply(displacement))


def laplacian_guess(
    cells: Cells, free: Bool[np.ndarray, "vertices"], dtype: np.dtype
) -> LaplacianGuess:
    """Set up the normal equations; a large factor is made when it is first used.

    ``free`` may be longer than the mesh (buckets.py).
    """
    laplacian = normalised_laplacian(cells.edges, cells.weights, cells.n_vertices)
    normal = enlarge(laplacian.T @ laplacian, len(free))
    # One width for all meshes, since it is multiplied with once a deformation.
    matrix = EllMatrix.build([[normal]], dtype, WIDTHS[-1])
    return LaplacianGuess(matrix, factorise(normal, free, dtype))
