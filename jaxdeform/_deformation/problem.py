"""A mesh with its cells and handles, factored once for every later deformation."""

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._arrays import is_concrete
from jaxdeform._checks import check_precision, check_type
from jaxdeform._deformation.covariance import stiffness
from jaxdeform._deformation.system import System, build_system, fingerprint, seal_of
from jaxdeform._errors import ArrayLike, InputError, a_or_an, first_few, shown
from jaxdeform._handles.split import HandleSplit, split_handles
from jaxdeform._linalg.buckets import bucket, cut, enlarge, fill_up
from jaxdeform._linalg.cholesky import Factor, NotPositiveDefinite, factorise
from jaxdeform._mesh.bounded import bounded_cells
from jaxdeform._mesh.cells import Cells, rings
from jaxdeform._mesh.laplacian import lifted_weights
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._values import read_rigidity

# Further from the origin, in diagonals, float32 keeps fewer than four digits of a position.
_FAR_IN_FLOAT32 = 1e3
# Energies are squares of lengths. Beyond this length, and below its inverse, they leave the range
# of float32: of a bar of 1e-15 the energy was 2 % off, and of 1e-18 it was 300 times too large.
_LARGEST_IN_FLOAT32 = 1e12


class Problem(eqx.Module):
    """A mesh with its cells and handles, factored. Made by `precompute`.

    A problem is a value: a pytree of arrays that can be copied, pickled, written to a file with
    ``equinox.tree_serialise_leaves``, returned from a jitted function or sent to another process.
    A factor that is not there yet is made there, from the matrix that the problem holds.

    **Fields**

    - system: the arrays that the iterations read.
    - handles: (handles,) indices of the handle vertices, in the order of the targets' rows.
    - cells: the cells (`rings` with r = 1 by default), with the weights that are computed with;
      None in a stack of problems (`stack_problems`).
    """

    system: System
    handles: Int[np.ndarray | Array, "*stack handles"]
    cells: Cells | None = eqx.field(static=True)

    @property
    def mesh(self) -> Mesh:
        """The rest shape. **Raises** InputError for a stack, which has many."""
        return self.own_cells.mesh

    @property
    def own_cells(self) -> Cells:
        """The cells. **Raises** InputError for a stack, which has those of many meshes."""
        if self.cells is None:
            raise InputError("a stack of problems has no mesh of its own: ask the problems in it")
        return self.cells

    @property
    def n_vertices(self) -> int:
        """Number of vertices; of a stack, the number that its arrays have."""
        return self.bucket if self.cells is None else self.cells.n_vertices

    @property
    def bucket(self) -> int:
        """Number of vertices of the arrays in ``system``; those beyond ``n_vertices`` are empty."""
        return self.system.rest.shape[-1]

    @property
    def vertices(self) -> Float[np.ndarray, "vertices 3"]:
        """Rest positions."""
        return self.mesh.vertices

    @property
    def handle_weights(self) -> Float[np.ndarray, "handles"]:
        """The weight of each handle, an area; infinite where it is hard."""
        handles = np.asarray(self.handles)
        hard = ~np.asarray(self.system.free)[handles]
        return np.where(hard, np.inf, np.asarray(self.system.soft, np.float64)[handles])

    @property
    def dtype(self) -> np.dtype:
        """Type of all numbers: float64 where JAX is set to it, else float32."""
        return np.dtype(self.system.rest.dtype)

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        if any(not hasattr(x, "shape") for x in (self.system.rest, self.handles)):
            return "Problem(without its arrays)"
        if self.system.rest.ndim > 2:
            return f"Problem({len(self.handles)} stacked, {self.bucket} vertices, {self.dtype})"
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

    One factor serves every rigidity, target, member of a batch and gradient, because A depends on
    the rest mesh, the cells and the handle set only (Eq. 4.5).

    **Arguments**

    - mesh: the rest shape.
    - handles: (handles,) vertex indices, each once, or a mask (vertices,), or a selection of
      ``jd.select``. Rows of targets are in their order; that of masks and selections is ascending.
    - cells: ``rings(mesh, r)`` or ``spokes(mesh)``; by default ``rings(mesh, 1)``.
    - handle_weights: a number or (handles,). With the default, infinity, a handle sits on its
      target. A finite weight w >= 0 pulls with ``w |p' - target|^2`` instead; its unit is that of
      the edge weights (none).
    - dtype: float32 or float64; by default float64 where ``jax_enable_x64`` is set.

    **Raises** InputError: no handles; an index out of range or repeated; a connected component of
    the mesh without a handle (it could lie anywhere); cells of another mesh; in float32, a mesh
    above 1e12 or below 1e-12 long.

    Unreferenced vertices stay where they are. Where negative weights leave the energy of a cell
    without a lower bound, they count as 0, with a warning that names the cells. So the energy has a
    lower bound for every rigidity >= 0.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> jd.precompute(mesh, handles).n_vertices
        722
    """
    check_type("mesh", mesh, Mesh)
    split = split_handles(mesh, handles, handle_weights)
    cells = rings(mesh, 1) if cells is None else cells
    check_type("cells", cells, Cells)
    if cells.mesh != mesh:
        raise InputError(
            f"cells are of another mesh ({cells.mesh}, not equal to this {mesh}): call "
            "rings(mesh, r) on this mesh"
        )
    dtype = _checked_dtype(dtype)
    center = mesh.center
    rest = mesh.vertices - center
    if dtype == np.float32 and np.abs(center).max() > _FAR_IN_FLOAT32 * mesh.diagonal:
        warnings.warn(
            f"the mesh lies {np.abs(center).max() / mesh.diagonal:.0f} diagonals from the origin: "
            "it is deformed about its own centre, but the positions that come back are rounded to "
            "float32. Move it to the origin, or use float64.",
            stacklevel=2,
        )
    if dtype == np.float32 and not 1 / _LARGEST_IN_FLOAT32 < mesh.diagonal < _LARGEST_IN_FLOAT32:
        raise InputError(
            f"the mesh is {mesh.diagonal:.3g} long: squares of lengths above "
            f"{_LARGEST_IN_FLOAT32:g} and below {1 / _LARGEST_IN_FLOAT32:g} leave the range of "
            "float32; give it in another unit of length, or use float64"
        )
    with jax.ensure_compile_time_eval():  # known numbers also inside jit
        used, matrix, factor = _factorise(cells, rest, split, dtype)
        return Problem(build_system(used, rest, split, matrix, factor, dtype), split.index, used)


def _checked_dtype(dtype: Any) -> np.dtype:
    try:
        kind = np.dtype(dtype if dtype is not None else jnp.result_type(float))
    except (TypeError, ValueError):
        raise InputError(f"dtype is {shown(dtype)}: use float32 or float64") from None
    if kind not in (np.float32, np.float64):
        raise InputError(f"dtype {kind} is not supported: use float32 or float64")
    if kind == np.float64 and not jax.config.read("jax_enable_x64"):
        raise InputError(
            'dtype float64 needs jax.config.update("jax_enable_x64", True) before anything else'
        )
    return kind


def _factorise(
    cells: Cells, rest: Float[np.ndarray, "vertices 3"], split: HandleSplit, dtype: np.dtype
) -> tuple[Cells, sp.csr_matrix, Factor]:
    """Factor A of cells whose energy has a lower bound, and return those cells and A."""
    size = bucket(cells.n_vertices)
    free = fill_up(split.free, size)
    positions = fill_up(rest.T, size).T
    used, bad = bounded_cells(cells)
    if bad.size:
        warnings.warn(
            f"negative weights (obtuse angles) leave the energy of {len(bad)} cells without a "
            f"lower bound (cells {first_few(bad)}): {int((used.weights != cells.weights).sum())} "
            "edge weights count as 0 there. Pass weights of your own, none negative, to decide "
            "otherwise.",
            stacklevel=3,
        )
    matrix = enlarge(stiffness(used) + sp.diags(split.soft), size)
    try:
        return used, matrix, factorise(matrix, free, dtype, positions=positions)
    except NotPositiveDefinite:
        pass
    if not (used.weights > 0).any():
        raise InputError(
            f"cells: none of their {len(used.weights)} edge weights is positive, so nothing holds "
            "the free vertices: give weights of your own to rings() or spokes(), such as "
            "cotangent_weights(mesh) or ones"
        )
    lifted = lifted_weights(used.weights)
    raised = int((lifted > used.weights).sum())
    used = dataclasses.replace(used, weights=lifted)
    matrix = enlarge(stiffness(used) + sp.diags(split.soft), size)
    try:
        factor = factorise(matrix, free, dtype, positions=positions)
    except NotPositiveDefinite as error:
        raise InputError(
            "the system of the free vertices is singular even with positive weights: the mesh "
            "spans too many orders of magnitude; see jd.inspect(mesh) and jd.repair(mesh)"
        ) from error
    warnings.warn(
        f"weights of 0 made the system singular: {raised} edge weights were lifted to "
        f"{lifted.min():.3g}. Pass weights of your own to rings() or spokes() to decide otherwise.",
        stacklevel=3,
    )
    return used, matrix, factor


def check_problem(problem: Any) -> None:
    """Raise InputError unless this is a problem, of one mesh, that JAX can compute with now."""
    check_type("problem", problem, Problem)
    _check_arrays(problem)
    check_precision("problem", problem.dtype)
    if problem.system.rest.ndim > 2:
        raise InputError(
            "problem: a stack of problems, which jax.vmap takes apart: call "
            "jax.vmap(lambda problem, targets: jd.deform(problem, targets, ...))(stack, targets)"
        )
    known, system, cells = is_concrete(problem), problem.system, problem.cells
    if known and cells and not np.array_equal(system.fingerprint, fingerprint(cells)):
        raise InputError(
            "problem: its arrays are of another mesh, or of other cells, than its cells: read a "
            "file of arrays into what precompute makes of the same mesh, handles and cells"
        )
    if known and not np.array_equal(system.seal, seal_of(system, problem.handles)):
        raise InputError(
            "problem: its arrays or handles are not those that precompute made together: they "
            "were changed, rounded, or come from two problems. Call precompute again"
        )


def _check_arrays(problem: Problem) -> None:
    """Raise InputError unless all arrays are there."""
    needed = vars(problem.system) | {"handles": problem.handles}
    if needed["sides"] is None:
        del needed["sides"]
    for leaf in jax.tree.leaves(needed, is_leaf=lambda x: x is None):
        if not isinstance(leaf, Array | np.ndarray):
            raise InputError(
                f"problem: holds {a_or_an(leaf)} where an array belongs: put its parts together "
                "first, as by equinox.combine"
            )
        if isinstance(leaf, Array) and is_concrete(leaf) and leaf.is_deleted():
            raise InputError(
                "problem: its arrays are deleted, as jit does with arguments that it may donate "
                "(donate_argnums): keep a copy, or call precompute again"
            )


def fits_cells(problem: Problem) -> Bool[Array, ""] | bool:
    """Return whether traced arrays are of the cells of the problem; a stack has none."""
    if problem.cells is None:
        return True
    return jnp.all(problem.system.fingerprint == fingerprint(problem.cells))


def rigidity_from_material(problem: Problem, constant: ArrayLike) -> Float[Array, "vertices"]:
    """Turn a scale-free material constant into the rigidity of each vertex.

    ``lambda_k = constant * tr(B_k) / 2``. The sum of w |e|^2 over a triangle's edges is twice its
    area, so tr(B_k) / 2 measures the area of the cell. The same constant resists stretch alike on a
    rescaled or refined mesh; the same lambda does not. Bending still depends on resolution: a sheet
    bends as if it were as thick as its cells are wide.

    **Arguments**: problem; constant >= 0, a number or (vertices,), without unit.

    **Returns** (vertices,), length squared. **Raises** InputError as for rigidity.

    Example:
        >>> import jaxdeform as jd
        >>> problem = jd.precompute(jd.shapes.bar(), [0])
        >>> jd.rigidity_from_material(problem, 0.2).shape
        (722,)
    """
    check_problem(problem)
    size = problem.bucket
    constant = read_rigidity(
        constant, problem.n_vertices, problem.dtype, name="constant", size=size
    )
    constant = jnp.asarray(fill_up(constant, size))
    trace = jnp.sum(problem.system.principal_moments, axis=0)
    return cut(constant * jnp.maximum(trace, 0.0) / 2.0, problem.n_vertices)
