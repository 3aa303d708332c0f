"""The global step: a sparse system factored once, solved in every iteration (Eq. 4.5).

The free unknowns are eliminated from the fixed ones beforehand: a factor holds the matrix of the
free vertices only, takes (..., 3, n) right-hand sides, ignores their fixed entries and returns
zeros there. All its shapes depend on the number of vertices alone, so another handle set runs the
code that is compiled already.

Up to DENSE_BELOW vertices it is the inverse; beyond, CHOLMOD's factor on the host where that is the
device, and on a GPU or TPU one made of products (nested_dissection.py).
"""

import itertools
import weakref
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from cholespy import CholeskySolverD, CholeskySolverF, MatrixType  # pyright: ignore[reportAttributeAccessIssue]
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._linalg.nested_dissection import DissectedFactor, dissected_factor

# Up to this many vertices the inverse is kept as a dense matrix (one product per solve, no call
# back to the host). Measured in docs/benchmarks.md: the two cross between 700 and 1,500 vertices.
DENSE_BELOW = 1000


class NotPositiveDefinite(Exception):
    """The matrix of the free vertices has no Cholesky factor."""


class DenseFactor(eqx.Module):
    """The inverse as a dense (n, n) matrix with zero rows and columns at the fixed vertices."""

    inverse: Float[Array, "n n"]

    def solve(self, right: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Return x with ``A_ff x_f = right_f`` and ``x = 0`` at fixed vertices."""
        # A GPU would by default round float32 to TF32, three digits, before it multiplies. So all
        # products of this package name their precision.
        return jnp.matmul(right, self.inverse, precision="highest")


class SparseFactor(eqx.Module):
    """A supernodal Cholesky factor on the host (CHOLMOD through cholespy), reached by number.

    The factor is C++ memory, not an array. Held as a static field it would be hashed by identity,
    and each new handle set would recompile everything. So the traced part is a number, a leaf like
    any other, and the host looks the factor up in a table that does not keep it alive.
    """

    number: Int[Array, ""]

    def solve(self, right: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Return x with ``A_ff x_f = right_f`` and ``x = 0`` at fixed vertices."""

        def host(_matvec, b):
            return jax.pure_callback(
                _solve_on_host,
                jax.ShapeDtypeStruct(b.shape, b.dtype),
                self.number,
                b,
                vmap_method="broadcast_all",
            )

        # custom_linear_solve gives the derivatives: a symmetric solve is its own adjoint. The
        # operator itself is never applied, because the matrix has no tangent.
        return jax.lax.custom_linear_solve(lambda x: x, right, host, symmetric=True)


class Anchor:
    """Keeps host factors alive for as long as the problem that uses them.

    As a static field it takes part in jit's cache key, so all anchors compare equal: another
    handle set is no reason to compile again.
    """

    def __init__(self, *factors: "HostFactor | None") -> None:
        """Hold on to the factors."""
        self._factors = factors

    def __eq__(self, other: object) -> bool:
        """Return True for any other anchor."""
        return isinstance(other, Anchor)

    def __hash__(self) -> int:
        """Return the hash that all anchors share."""
        return hash(Anchor)


class HostFactor:
    """Factors on first use, because the start's matrix is not needed by those who bring a start."""

    def __init__(self, matrix: sp.spmatrix, free: Bool[np.ndarray, "n"], dtype: np.dtype) -> None:
        """Keep the free part of the matrix."""
        self._index = np.flatnonzero(free)
        self._matrix: sp.csr_matrix | None = _inner(matrix, self._index)
        self._kind = CholeskySolverF if dtype == np.float32 else CholeskySolverD
        self._solver: Any = None

    def factorise(self):
        """Return the factor of a matrix with at least one row, made at the first call."""
        if self._matrix is not None:
            entries = self._matrix.tocoo()
            try:
                self._solver = self._kind(
                    len(self._index),
                    entries.row.astype(np.int32),
                    entries.col.astype(np.int32),
                    entries.data.astype(np.float64),
                    MatrixType.COO,
                )
            except ValueError as error:
                raise NotPositiveDefinite(str(error)) from error
            self._matrix = None
        return self._solver

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution of all right-hand sides (..., n) together."""
        out = np.zeros(right.shape, right.dtype)
        if not len(self._index):
            return out
        flat = right.reshape(-1, right.shape[-1])
        b = np.ascontiguousarray(flat[:, self._index].T)
        x = np.zeros_like(b)
        self.factorise().solve(b, x)
        out.reshape(flat.shape)[:, self._index] = x.T
        return out


def _inner(matrix: sp.spmatrix, index: np.ndarray) -> sp.csr_matrix:
    return sp.csr_matrix(sp.csr_matrix(matrix)[index][:, index])


_factors: "weakref.WeakValueDictionary[int, HostFactor]" = weakref.WeakValueDictionary()
_numbers = itertools.count()


def _solve_on_host(number, right):
    number, right = np.asarray(number), np.asarray(right)
    if number.ndim == 0:
        return _lookup(int(number)).solve(right)
    if (number == number.flat[0]).all():
        return _lookup(int(number.flat[0])).solve(right)  # one factor, many columns together
    lead = number.ndim
    out = np.empty(right.shape, right.dtype)
    for at in np.ndindex(*right.shape[:lead]):
        out[at] = _lookup(int(np.broadcast_to(number, right.shape[:lead])[at])).solve(right[at])
    return out


def _lookup(number: int) -> HostFactor:
    try:
        return _factors[number]
    except KeyError:
        raise RuntimeError(
            "the factor of this problem is gone: keep the problem that precompute returned alive "
            "while functions made from it run, and make it in the process that uses it"
        ) from None


Factor = DenseFactor | DissectedFactor | SparseFactor


def factorise(
    matrix: sp.spmatrix,
    free: Bool[np.ndarray, "n"],
    dtype: np.dtype,
    *,
    positions: Float[np.ndarray, "n 3"] | None = None,
) -> tuple[Factor, "HostFactor | None"]:
    """Return a factor of the free part of a symmetric positive definite matrix (n, n).

    With it comes what an :class:`Anchor` must hold, None unless the factor is on the host.

    Without positions, where the unknowns lie, a large factor is on the host in any case and made at
    the first solve: for what is solved once a deformation.

    **Raises** NotPositiveDefinite.
    """
    try:
        if matrix.shape[0] <= DENSE_BELOW:
            return _dense_factor(matrix, free, dtype), None
        if positions is not None and has_accelerator():
            return dissected_factor(matrix, free, positions, np.dtype(dtype)), None
    except np.linalg.LinAlgError as error:
        raise NotPositiveDefinite(str(error)) from error
    host = HostFactor(matrix, free, np.dtype(dtype))
    if positions is not None and free.any():
        host.factorise()
    number = next(_numbers)
    _factors[number] = host
    return SparseFactor(jnp.asarray(number, jnp.int32)), host


def _dense_factor(matrix: sp.spmatrix, free: Bool[np.ndarray, "n"], dtype) -> DenseFactor:
    n, index = matrix.shape[0], np.flatnonzero(free)
    inverse = np.zeros((n, n))
    if len(index):
        lower = np.linalg.cholesky(_inner(matrix, index).toarray())
        half = np.linalg.solve(lower, np.eye(len(index)))
        inverse[np.ix_(index, index)] = half.T @ half
    return DenseFactor(jnp.asarray(inverse, dtype))


def has_accelerator() -> bool:
    """Whether calls back to the host would cost more than the products that avoid them."""
    return jax.default_backend() != "cpu"
