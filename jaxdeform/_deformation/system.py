"""All that the iterations read, as arrays whose shapes meshes of about one size share."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxdeform._deformation.covariance import CovarianceMap, covariance_blocks
from jaxdeform._deformation.initial_guess import LaplacianGuess, laplacian_guess
from jaxdeform._handles.split import HandleSplit
from jaxdeform._linalg.buckets import bucket, fill_up, next_of
from jaxdeform._linalg.cholesky import Factor
from jaxdeform._linalg.ell import EllMatrix
from jaxdeform._mesh.cells import Cells, principal_moments
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.normals import corner_sides
from jaxdeform._mesh.polygons import from_triangles

# Faces for each vertex: closed meshes have just below 2.
_FACES = (2.05,)


class System(eqx.Module):
    """All that the iterations read. Vertices are the last axis; they alone determine the shapes.

    There are as many as the bucket of the mesh has (buckets.py): after its own come fixed ones at
    its centre, whose cells are empty.
    """

    rest: Float[Array, "3 vertices"]
    """Rest positions, moved so that their centre is the origin."""
    center: Float[Array, "3"]
    free: Bool[Array, "vertices"]
    soft: Float[Array, "vertices"]
    """Weight of each soft handle, 0 elsewhere."""
    principal_moments: Float[Array, "3 vertices"]
    principal_axes: Float[Array, "3 3 vertices"]
    """Columns are the axes: (world axis, principal axis, cell)."""
    covariance: CovarianceMap
    stiffness: EllMatrix
    """A, with the weights of the soft handles on its diagonal."""
    factor: Factor
    initial_guess: LaplacianGuess
    fingerprint: UInt32[Array, "2"]
    """Of the cells and their mesh, which stand beside these arrays and may come from elsewhere."""
    faces: Int[Array, "faces 3"]
    sides: Float[Array, "faces 3"] | None
    """-1 where a face is turned over as seen from a corner; None stands for 1 everywhere."""

    def held(self, x: Float[Array, "3 vertices"]) -> Float[Array, "3 vertices"]:
        """Return x at the vertices that are not free, 0 elsewhere.

        Added to a Hessian, which is 0 there, it makes the system regular.
        """
        return jnp.where(self.free[None], 0.0, x)


def build_system(
    cells: Cells,
    rest: Float[np.ndarray, "vertices 3"],
    split: HandleSplit,
    matrix: sp.csr_matrix,
    factor: Factor,
    dtype: np.dtype,
) -> System:
    """Return the system of cells, given A, which is as large as their bucket, and its factor."""
    mesh, size = cells.mesh, bucket(cells.n_vertices)
    put = lambda x: jax.device_put(np.asarray(x, dtype))  # noqa: E731 (compiles nothing)
    moments, axes = principal_moments(cells)
    all_axes = np.tile(np.eye(3)[..., None], size)
    all_axes[..., : len(axes)] = axes.transpose(1, 2, 0)
    faces, sides = _filled_up_faces(mesh, size)
    led = fill_up(split.free & (split.soft == 0), size)
    return System(
        rest=put(fill_up(rest.T, size)),
        center=put(mesh.center),
        free=jax.device_put(fill_up(split.free, size)),
        soft=put(fill_up(split.soft, size)),
        principal_moments=put(fill_up(moments.T, size)),
        principal_axes=put(all_axes),
        covariance=CovarianceMap.of(covariance_blocks(cells, rest, axes, size), dtype),
        stiffness=EllMatrix.build([[matrix]], dtype),
        factor=factor,
        initial_guess=laplacian_guess(cells, led, dtype),
        fingerprint=jax.device_put(fingerprint(cells)),
        faces=jax.device_put(faces),
        sides=None if sides is None else put(sides),
    )


def fingerprint(cells: Cells) -> UInt32[np.ndarray, "2"]:
    """Return what tells these cells from others, of this mesh or another."""
    return np.frombuffer(cells.digest[:8], np.uint32)


def _filled_up_faces(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return faces and sides; faces without area fill them up."""
    count = int(next_of(_FACES, len(mesh.faces) / size) * size)
    faces = fill_up(mesh.faces.T.astype(np.int32), count).T
    sides = corner_sides(from_triangles(mesh.faces))
    if sides is None:
        return faces, None
    return faces, fill_up(sides.reshape(-1, 3).T, count, 1.0).T
