"""All that the iterations read, as arrays whose shapes meshes of about one size share."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxdeform._deformation.covariance import CovarianceMap, covariance_blocks
from jaxdeform._deformation.initial_guess import LaplacianGuess, laplacian_guess
from jaxdeform._errors import ArrayLike
from jaxdeform._handles.split import HandleSplit
from jaxdeform._linalg.buckets import bucket, fill_up, next_of
from jaxdeform._linalg.cholesky import Factor, HostCholesky
from jaxdeform._linalg.ell import EllMatrix
from jaxdeform._mesh.cells import Cells, principal_moments
from jaxdeform._mesh.mesh import Mesh, content_digest
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
    seal: UInt32[Array, "2"]
    """Of the handles and of these arrays, as far as they are small: see `seal_of`."""
    faces: Int[Array, "faces 3"]
    sides: Float[Array, "faces 3"] | None
    """-1 where a face is turned over as seen from a corner; None stands for 1 everywhere."""

    def sealed(self, handles: ArrayLike) -> "System":
        """Return the system with the seal of its arrays and these handles."""
        return dataclasses.replace(self, seal=jax.device_put(seal_of(self, handles)))

    @property
    def led(self) -> Bool[Array, "vertices"]:
        """True where the first guess is given: at fixed vertices and soft handles."""
        return ~self.free | (self.soft > 0)

    def into_axes(self, t: Float[Array, "3 3 vertices"]) -> Float[Array, "3 3 vertices"]:
        """Return transformations of world axes as those of the principal axes of the cells."""
        return jnp.einsum("aik,ijk->ajk", t, self.principal_axes, precision="highest")

    def out_of_axes(self, t: Float[Array, "3 3 vertices"]) -> Float[Array, "3 3 vertices"]:
        """Return transformations of the principal axes of the cells as those of world axes."""
        return jnp.einsum("aik,jik->ajk", t, self.principal_axes, precision="highest")

    def at_fixed(self, x: Float[Array, "3 vertices"]) -> Float[Array, "3 vertices"]:
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
    unled = fill_up(split.free & (split.soft == 0), size)
    system = System(
        rest=put(fill_up(rest.T, size)),
        center=put(mesh.center),
        free=jax.device_put(fill_up(split.free, size)),
        soft=put(fill_up(split.soft, size)),
        principal_moments=put(fill_up(moments.T, size)),
        principal_axes=put(all_axes),
        covariance=CovarianceMap.of(covariance_blocks(cells, rest, axes, size), dtype),
        stiffness=EllMatrix.build([[matrix]], dtype),
        factor=factor,
        initial_guess=laplacian_guess(cells, unled, dtype),
        fingerprint=jax.device_put(fingerprint(cells)),
        seal=jax.device_put(np.zeros(2, np.uint32)),
        faces=jax.device_put(faces),
        sides=None if sides is None else put(sides),
    )
    return system.sealed(split.index)


def fingerprint(cells: Cells) -> UInt32[np.ndarray, "2"]:
    """Return what tells these cells from others, of this mesh or another."""
    return np.frombuffer(cells.digest[:8], np.uint32)


def seal_of(system: System, handles: ArrayLike) -> UInt32[np.ndarray, "2"]:
    """Return what tells arrays and handles that were made together from others.

    Of what is read here: the place of every vertex, whether it is free, and which factor it is, if
    that is on the host. (To read the matrices too would take as long as an iteration.)
    """
    own = [system.rest, system.center, system.free, system.soft, system.principal_moments]
    if isinstance(system.factor, HostCholesky):
        own.append(system.factor.key)
    digest = content_digest(np.asarray(handles, np.int64), *map(np.asarray, own))
    return np.frombuffer(digest[:8], np.uint32)


def _filled_up_faces(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return faces and sides; faces without area fill them up."""
    count = int(next_of(_FACES, len(mesh.faces) / size) * size)
    faces = fill_up(mesh.faces.T.astype(np.int32), count).T
    sides = corner_sides(from_triangles(mesh.faces))
    if sides is None:
        return faces, None
    return faces, fill_up(sides.reshape(-1, 3).T, count, 1.0).T
