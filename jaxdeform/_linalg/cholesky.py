"""The global step: a sparse system factored once, solved in every iteration (Eq. 4.5).

Fixed vertices are eliminated first: a factor holds only the free-free block A_ff. It takes
right-hand sides (..., 3, vertices), ignores their fixed entries and returns zeros there. All its
shapes depend on the mesh alone, so another handle set runs the code that is compiled already.

On a CPU it is CHOLMOD's factor on the host (factor_cache.py). On a GPU or TPU it is one made of
products (nested_dissection.py) or, for small meshes, the inverse.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int32, UInt32

from jaxdeform._linalg.factor_cache import SHIFTS, Matrix, NotPositiveDefinite, cholesky, factors
from jaxdeform._linalg.ffi import installed_interface
from jaxdeform._linalg.host_call import HostFunction
from jaxdeform._linalg.nested_dissection import DissectedFactor, dissected_factor
from jaxdeform._linalg.xla import has_accelerator

# Up to this many vertices the inverse is kept as a dense matrix where calls to the host are slow:
# where there is an accelerator, or no FFI (ffi.py).
DENSE_BELOW = 1000


class DenseInverse(eqx.Module):
    """The inverse as a dense matrix, with zero rows and columns at the fixed vertices."""

    inverse: Float[Array, "vertices vertices"]

    def solve(self, right: Float[Array, "... vertices"]) -> Float[Array, "... vertices"]:
        """Return x with ``A_ff x_f = right_f`` and ``x = 0`` at fixed vertices."""
        # A GPU would by default round float32 to TF32, three digits, before it multiplies. So all
        # products of this package name their precision.
        return jnp.matmul(right, self.inverse, precision="highest")


class HostCholesky(eqx.Module):
    """The matrix itself; its Cholesky factor is made and kept by each process that solves.

    A factor is C++ memory: it cannot be traced, pickled, or sent to another process. So the value
    is the matrix, and the factor is looked up by a hash of the content, and made where it is
    missing (factor_cache.py). What is solved depends on the arrays here and on nothing else.
    """

    key: UInt32[Array, "4"]
    starts: Int32[Array, "columns"]
    rows: Int32[Array, "entries"]
    values: UInt32[Array, "entries 2"]
    free: Bool[Array, "vertices"]

    def solve(self, right: Float[Array, "... vertices"]) -> Float[Array, "... vertices"]:
        """Return x with ``A_ff x_f = right_f`` and ``x = 0`` at fixed vertices."""
        # custom_linear_solve gives the derivatives: a symmetric solve is its own adjoint. The
        # operator itself is never applied, because the matrix has no tangent.
        on_host = lambda _, b: _call_host(self, b)  # noqa: E731
        return jax.lax.custom_linear_solve(lambda x: x, right, on_host, symmetric=True)


@jax.jit
def _call_host(
    factor: HostCholesky, right: Float[Array, "... vertices"]
) -> Float[Array, "... vertices"]:
    """Call the host with columns (n, k), as CHOLMOD wants them, and zeros at fixed unknowns."""
    columns = right.reshape(math.prod(right.shape[:-1]), right.shape[-1]).T
    columns = jnp.where(factor.free[:, None], columns, jnp.zeros((), right.dtype))
    matrix = factor.key, factor.starts, factor.rows, factor.values, factor.free
    result = jax.ShapeDtypeStruct(columns.shape, columns.dtype)
    return _host_solve(result, *matrix, columns).T.reshape(right.shape)


Factor = DenseInverse | DissectedFactor | HostCholesky


def factorise(
    matrix: sp.spmatrix,
    free: Bool[np.ndarray, "vertices"],
    dtype: np.dtype,
    *,
    positions: Float[np.ndarray, "vertices 3"] | None = None,
) -> Factor:
    """Return a factor of the free part of a symmetric positive definite matrix.

    Without positions, where the unknowns lie, it is for a first guess, solved once a deformation:
    a factor on the host is made at the first solve, and a matrix that rounding has made indefinite
    gets up to 1e-6 of its diagonal added.

    **Raises** NotPositiveDefinite.
    """
    dtype, exact = np.dtype(dtype), positions is not None
    shifts = SHIFTS[:1] if exact else SHIFTS
    accelerator = has_accelerator()
    if (accelerator or not _host_solve.native) and matrix.shape[0] <= DENSE_BELOW:
        return dense_inverse(matrix, free, dtype, shifts)
    if accelerator and positions is not None:
        try:
            return dissected_factor(matrix, free, positions, dtype)
        except np.linalg.LinAlgError as error:
            raise NotPositiveDefinite(str(error)) from error
    content = Matrix.of(matrix, free).filled_up(first=not exact)
    key = content.key()
    if exact:
        factors.get(key, content, dtype, shifts)
    factor = HostCholesky(*jax.device_put([key, *content]))
    factors.own(key, factor.key)
    return factor


def own_factors(stack: Any) -> None:
    """Keep the factors on the host that are in a stack of systems for as long as it lives."""
    is_factor = lambda x: isinstance(x, HostCholesky)  # noqa: E731
    for factor in filter(is_factor, jax.tree.leaves(stack, is_leaf=is_factor)):
        for key in np.asarray(factor.key):
            factors.own(key, factor.key)


def dense_inverse(
    matrix: sp.spmatrix,
    free: Bool[np.ndarray, "vertices"],
    dtype: np.dtype,
    shifts: tuple[float, ...] = SHIFTS[:1],
) -> DenseInverse:
    """Return the inverse of the free part. **Raises** NotPositiveDefinite."""
    # By CHOLMOD's one thread. The threads of NumPy's and SciPy's dense solvers wait for each other
    # by spinning: 2.3 CPU seconds for 722 vertices on a busy machine, where this takes 0.02.
    right = np.diag(free.astype(np.float64))
    inverse = np.empty_like(right)
    cholesky(Matrix.of(matrix, free).inner(), np.dtype(np.float64), shifts).solve(right, inverse)
    return DenseInverse(jax.device_put((0.5 * (inverse + inverse.T)).astype(dtype)))


# ---------------------------------------------------------------- on the host


def _solve_on_host(out: np.ndarray, *operands: np.ndarray) -> None:
    """Solve for columns (..., n, k), the last operand; the leading axes are those of vmap.

    One matrix for all: all columns are solved together.
    """
    *matrix, columns = operands
    lead = columns.ndim - 2
    if not lead:
        _solve_columns(out, matrix, columns)
        return
    batch = np.broadcast_shapes(*(x.shape[:lead] for x in matrix))
    for member in np.ndindex(batch):
        one = [x[tuple(i % size for i, size in zip(member, x.shape, strict=False))] for x in matrix]
        shared = tuple(
            slice(None) if size == 1 else i for i, size in zip(member, batch, strict=True)
        )
        out[shared] = solve_together(
            _solve_columns, one, np.broadcast_to(columns, out.shape)[shared]
        )


def solve_together(
    solve: Callable[[np.ndarray, list[Any], np.ndarray], None],
    matrix: list[Any],
    columns: Float[np.ndarray, "*members n k"],
) -> Float[np.ndarray, "*members n k"]:
    """Return the solution of one matrix for all members, whose columns are solved side by side."""
    packed = np.moveaxis(columns, -2, 0)
    solution = np.empty(packed.shape, columns.dtype)
    flat = len(solution), -1
    solve(solution.reshape(flat), matrix, packed.reshape(flat))
    return np.moveaxis(solution, 0, -2)


def _solve_columns(out: np.ndarray, matrix: list[np.ndarray], columns: np.ndarray) -> None:
    key, *content = matrix
    if not (key.any() or any(x.any() for x in content)):
        # Solvers that carry a linearised function through a loop, optimistix's among them, begin
        # with zeros in place of all its arrays, and discard what comes out.
        out[...] = 0
        return
    factor = factors.get(key, Matrix(*content), columns.dtype)
    factor.solve(columns, out)


_host_solve = HostFunction("jaxdeform_cholesky_solve", _solve_on_host, installed_interface())
