"""A mesh with its cells and handles, factored once for every later deformation."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxdeform._deformation.initial_guess import LaplacianStart, laplacian_start
from jaxdeform._mesh.cells import Cells, moments, rings
from jaxdeform._mesh.mesh import Mesh
from jaxdeform.checks import check_components, check_handle_weights, check_handles, check_rigidity
from jaxdeform.energy import Rows, Scatter, scatter, stiffness
from jaxdeform.errors import InputError
from jaxdeform.global_step import Anchor, Factor, NotPositiveDefinite, factorise


class System(eqx.Module):
    """Everything of a problem that the iterations read, vertex axis last, all shapes by n alone."""

    rest: Float[Array, "3 n"]
    """Rest positions, moved so that their centre is the origin."""
    center: Float[Array, "3"]
    free: Bool[Array, "n"]
    soft: Float[Array, "n"]
    """Weight of the pull of each soft handle, 0 elsewhere."""
    b: Float[Array, "3 n"]
    frames: Float[Array, "3 3 n"]
    scatter: Scatter
    stiffness: Rows
    factor: Factor
    start: LaplacianStart
    faces: Int[Array, "m 3"]


class Problem(eqx.Module):
    """A mesh with its cells and handles, factored. Made by :func:`precompute`."""

    system: System
    handles: Int[np.ndarray, "h"]
    """Indices of the handle vertices, in the order of the targets' rows."""
    anchor: Anchor = eqx.field(static=True, repr=False)

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return self.system.rest.shape[1]

    @property
    def vertices(self) -> Float[Array, "n 3"]:
        """Rest positions."""
        return (self.system.rest + self.system.center[:, None]).T

    @property
    def dtype(self) -> np.dtype:
        """Type of all numbers: float64 where JAX is set to it, else float32."""
        return np.dtype(self.system.rest.dtype)

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        return f"Problem({self.n_vertices} vertices, {len(self.handles)} handles, {self.dtype})"


def precompute(
    mesh: Mesh,
    handles: ArrayLike,
    *,
    cells: Cells | None = None,
    handle_weights: ArrayLike = np.inf,
    dtype: np.dtype | type | None = None,
) -> Problem:
    """Factor the global step of a mesh and a set of handles, once for every later deformation.

    One factorisation serves every rigidity, every target, every batch lane and every gradient,
    because A depends on the rest mesh, the cells and the handle set only (Eq. 4.5).

    **Arguments**

    - mesh: the rest shape.
    - handles: (h,) vertex indices, each once.
    - cells: ``rings(mesh, r)`` or ``spokes(mesh)``; ``rings(mesh, 1)`` if left out.
    - handle_weights: a number or (h,). Infinite (the default): the handle sits on its target. A
      finite weight w >= 0 pulls with ``w |p' - target|^2`` instead; its unit is that of the edge
      weights (none).
    - dtype: float32 or float64; by default float64 where ``jax_enable_x64`` is set.

    **Raises** InputError: no handles; an index out of range or repeated; a connected part of the
    mesh without any handle (it could lie anywhere); cells of another mesh.

    Unreferenced vertices stay where they are. Where negative cotangent weights make A indefinite,
    they are lifted to 1e-3 of the mean weight, with a warning.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> y = mesh.vertices[:, 1]
        >>> handles = ((y < 6) | (y > 145)).nonzero()[0]
        >>> problem = jd.precompute(mesh, handles)
    """
    n = mesh.n_vertices
    index = check_handles(handles, n)
    cells = rings(mesh, 1) if cells is None else cells
    if cells.n_vertices != n or len(cells.edges) != len(mesh.edges):
        raise InputError(
            f"cells are of another mesh ({cells.n_vertices} vertices, {len(cells.edges)} edges; "
            f"this one has {n} and {len(mesh.edges)}): call rings(mesh, r) on this mesh"
        )
    pull = check_handle_weights(handle_weights, index)
    referenced = np.zeros(n, bool)
    referenced[mesh.faces.ravel()] = True
    check_components(mesh, index[pull > 0], referenced)

    kind = np.dtype(dtype if dtype is not None else jnp.result_type(float))
    if kind not in (np.float32, np.float64):
        raise InputError(f"dtype {kind} is not supported: use float32 or float64")
    if kind == np.float64 and not jax.config.read("jax_enable_x64"):
        raise InputError(
            'dtype float64 needs jax.config.update("jax_enable_x64", True) before anything else'
        )
    free = referenced.copy()
    free[index[np.isinf(pull)]] = False
    soft = np.zeros(n)
    finite = np.isfinite(pull)
    soft[index[finite]] = pull[finite]

    center = mesh.vertices[referenced].mean(axis=0)
    rest = mesh.vertices - center
    cells, matrix, factor, held = _factorise(cells, rest, free, soft, kind)
    b, frames = moments(cells.edges, cells.weights, cells.membership, rest)
    start, start_held = laplacian_start(cells, free & (soft == 0), kind)
    system = System(
        rest=jnp.asarray(rest.T, kind),
        center=jnp.asarray(center, kind),
        free=jnp.asarray(free),
        soft=jnp.asarray(soft, kind),
        b=jnp.asarray(b.T, kind),
        frames=jnp.asarray(frames.transpose(1, 2, 0), kind),
        scatter=scatter(cells, rest, frames, kind),
        stiffness=Rows.build([sp.csr_matrix(matrix)], kind),
        factor=factor,
        start=start,
        faces=jnp.asarray(mesh.faces, jnp.int32),
    )
    return Problem(system, index, Anchor(held, start_held))


def _factorise(cells: Cells, rest, free: np.ndarray, soft: np.ndarray, dtype: np.dtype):
    matrix = stiffness(cells) + sp.diags(soft)
    try:
        return cells, matrix, *factorise(matrix, free, dtype, positions=rest)
    except NotPositiveDefinite:
        pass
    floor = 1e-3 * np.abs(cells.weights).mean()
    raised = int((cells.weights < floor).sum())
    cells = Cells(cells.edges, np.maximum(cells.weights, floor), cells.membership)
    matrix = stiffness(cells) + sp.diags(soft)
    try:
        factored = factorise(matrix, free, dtype, positions=rest)
    except NotPositiveDefinite as error:
        raise InputError(
            "the system of the free vertices is singular even with positive weights: the mesh "
            "spans too many orders of magnitude; see jd.inspect(mesh) and jd.repair(mesh)"
        ) from error
    warnings.warn(
        f"negative or zero weights made the system indefinite: {raised} edge weights were lifted "
        f"to {floor:.3g}. Pass weights of your own to rings() or spokes() to decide otherwise.",
        stacklevel=3,
    )
    return cells, matrix, *factored


def material(problem: Problem, constant: ArrayLike) -> Float[Array, "n"]:
    """Turn a scale-free, resolution-free material constant into the rigidity of each vertex.

    ``lambda_k = constant * tr(B_k) / 2``: the sum of w |e|^2 over a triangle's edges is twice its
    area, so tr(B_k) / 2 measures the area of the cell. The same constant is the same material on a
    rescaled or refined mesh, which the same lambda is not.

    **Arguments**: problem; constant >= 0, a number or (n,), without unit. **Returns** (n,).
    **Raises** InputError as for rigidity.

    Example:
        >>> import jaxdeform as jd
        >>> problem = jd.precompute(jd.shapes.bar(), [0])
        >>> jd.material(problem, 0.2).shape
        (722,)
    """
    constant = check_rigidity(constant, problem.n_vertices, problem.dtype, name="constant")
    return jnp.asarray(constant) * jnp.maximum(jnp.sum(problem.system.b, axis=0), 0.0) / 2.0
