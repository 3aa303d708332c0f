"""The factor of the metric that knows the rigidity, on the host (metric.py has what it is).

A process keeps it by content, like that of A (factor_cache.py). Rigidities are rounded up to half
octaves, so that a fit, which changes them a little each time, meets the same factor again: a metric
that is too stiff is safe. (Evaluations without rounding, with half and with whole octaves: cactus
of constant 0.01 19, 20, 22; bar of 0.2 35, 29, 44.)
"""

import hashlib
from collections import defaultdict
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from jaxdeform._linalg.cholesky import solve_together
from jaxdeform._linalg.ell import sparse_blocks
from jaxdeform._linalg.factor_cache import (
    HostFactor,
    Matrix,
    NotPositiveDefinite,
    factors,
    mixed_up,
)
from jaxdeform._linalg.ffi import installed_interface
from jaxdeform._linalg.host_call import HostFunction

# Tried in turn where rounding leaves no Cholesky factor: the fraction of A that is mixed in.
_MIXES = (0.0, 1e-6, 1e-3, 0.1)
# K in float32 is off by 1e-7 of what A weighs in each cell.
_FLOAT32_MIXES = (1e-5, 1e-3, 0.1)

# It is used where this fraction of all cells is softer than this constant (rigidity_from_material).
_SOFT_PART, _SOFT = 0.1, 1.0
# Softer cells count as of this constant.
_LEAST = 1e-6


class _Operands(NamedTuple):
    key: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    values: np.ndarray
    free: np.ndarray
    moments: np.ndarray
    covariance: list[np.ndarray]

    @staticmethod
    def of(arrays) -> "_Operands":
        key, starts, rows, values, free, moments, *covariance = arrays
        return _Operands(key, starts, rows, values, free, moments, covariance)

    @property
    def stiffness(self) -> Matrix:
        return Matrix(self.starts, self.rows, self.values, self.free)


def _key_on_host(out, *given) -> None:
    """Return the key of the metric, or of A where that is as good; leading axes are members."""
    lead = out.ndim - 1
    own = [np.broadcast_to(x, (*out.shape[:-1], *x.shape[lead:])) for x in given]
    for member in np.ndindex(out.shape[:-1]):
        always, rigidity, *arrays = (x[member] for x in own)
        operands = _Operands.of(arrays)
        usable = bool(np.isfinite(rigidity).all() and (rigidity >= 0).all())
        if usable and (always or _is_soft(rigidity, operands.moments)):
            digest = hashlib.blake2b(digest_size=16)
            rounded = _rounded_up(rigidity, operands.moments)
            for array in (rounded, operands.key, operands.moments, *operands.covariance):
                digest.update(np.ascontiguousarray(array).data)
            out[member] = np.frombuffer(digest.digest(), np.uint32)
        else:
            out[member] = operands.key


def _is_soft(rigidity: np.ndarray, moments: np.ndarray) -> bool:
    area = _area(moments)
    cells = np.count_nonzero(area)  # without the empty ones
    return bool(np.sum(rigidity < _SOFT * area) >= _SOFT_PART * max(cells, 1))


def _rounded_up(rigidity: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return the next half octave, and at least what keeps the metric regular."""
    felt = np.maximum(rigidity.astype(np.float64), _LEAST * _area(moments))
    with np.errstate(divide="ignore"):
        return np.exp2(np.ceil(2.0 * np.log2(felt)) / 2.0)


def _area(moments: np.ndarray) -> np.ndarray:
    """Return tr(B) / 2 of each cell, which is about its area."""
    return np.maximum(moments.sum(axis=0), 0.0) / 2.0


def _solve_on_host(out, *given) -> None:
    """Solve for columns (..., n, 3). Members of a batch with the same factor go together."""
    *given, columns = given
    lead = columns.ndim - 2
    if not lead:
        _solve_columns(out, given, columns)
        return
    groups = defaultdict(list)
    batch = out.shape[:lead]
    own = [np.broadcast_to(x, (*batch, *x.shape[lead:])) for x in given]
    for member in np.ndindex(batch):
        groups[own[0][member].tobytes(), bool(own[1][member])].append(member)
    columns = np.broadcast_to(columns, out.shape)
    for members in groups.values():
        which = tuple(np.array(members).T)
        one = [x[members[0]] for x in own]
        out[which] = solve_together(_solve_columns, one, columns[which])


def _solve_columns(out, given, columns) -> None:
    key, safe, rigidity, *arrays = given
    if not key.any():
        out[...] = 0  # solvers that carry linear functions through loops begin with zeros
        return
    operands = _Operands.of(arrays)
    if safe or np.array_equal(key, operands.key):
        factor = factors.get(operands.key, operands.stiffness, columns.dtype)
    else:
        factor = factors.find(key, columns.dtype, partial(_make, rigidity, operands, columns.dtype))
    factor.solve(columns, out)


def _make(rigidity: np.ndarray, operands: _Operands, dtype: np.dtype) -> HostFactor:
    """Factor the metric, or A where that fails.

    **Raises** ValueError where A is not that of its key: the factor would be kept under that name.
    """
    if not np.array_equal(operands.stiffness.key(), operands.key):
        raise mixed_up()
    stiffness = _symmetric(operands.stiffness)
    pull = sp.vstack(sparse_blocks(*operands.covariance), format="csr").astype(np.float64)
    if dtype == np.float32:
        # Rows of K sum to 0: a translation pulls at nothing.
        n = len(operands.free)
        excess = np.asarray(pull.sum(axis=1)).ravel()
        pull = pull - sp.csr_matrix((excess, (np.arange(3 * n), np.tile(np.arange(n), 3))))
    inverse = compliance(operands.moments, _rounded_up(rigidity, operands.moments)).ravel()
    softened = pull.T @ sp.diags(inverse) @ pull
    for mix in _FLOAT32_MIXES if dtype == np.float32 else _MIXES:
        matrix = Matrix.of(stiffness - (1.0 - mix) * softened, operands.free)
        try:
            return HostFactor.of(matrix, dtype, shifts=(0.0,))
        except NotPositiveDefinite:
            continue
    return HostFactor.of(operands.stiffness, dtype)


def compliance(moments: np.ndarray, rigidity: np.ndarray) -> np.ndarray:
    """Return the mean of 1 / b and 1 / (b + 4 lambda), (3, cells); 0 along axes without extent."""
    b = np.maximum(moments.astype(np.float64), 0.0)
    flat = b <= 1e-9 * b.max(axis=0)
    b = np.where(flat, 1.0, b)
    return np.where(flat, 0.0, 0.5 / b + 0.5 / (b + 4.0 * rigidity))


def _symmetric(lower: Matrix) -> sp.csc_matrix:
    n, (rows, values) = len(lower.free), lower.entries
    matrix = sp.csc_matrix((values, rows, lower.starts), shape=(n, n))
    return matrix + sp.tril(matrix, -1).T


metric_key = HostFunction("jaxdeform_metric_key", _key_on_host, installed_interface())
metric_solve = HostFunction("jaxdeform_metric_solve", _solve_on_host, installed_interface())
