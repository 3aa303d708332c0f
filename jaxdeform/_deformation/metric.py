"""The metric of the descent: an inverse Hessian that knows the rigidity of every cell.

The reduced energy has the Hessian ``A - K^T (dT/dC) K`` (times 2). A itself, the matrix of Eq. 4.5,
is that of infinitely stiff cells. It serves every rigidity, but soft cells follow their vertices,
and then nearly all of A cancels. With the principal moments b of the cells, and

    H(x) = A - sum over cells and axes c of K_c^T diag(1 / (b_c + x)) K_c,

the true Hessian at unstrained cells, in any rotation, lies between H(0) and H(4 lambda): the strain
energy of Eq. 4.2 resists a change of T by 0 (a rotation) to 4 lambda (a stretch along an axis). The
metric is half their sum. The true Hessian is at most twice that, so a plain step of this metric
cannot raise the quadratic model. (docs/mathematics.md has the proof.)

Like A it is one matrix (vertices, vertices) for x, y and z, and its factor is kept by content
(factor_cache.py). Rigidities are rounded up to half octaves, so that a fit, which changes them a
little each time, meets the same factor again: a metric that is too stiff is safe. (Evaluations
without rounding, with half and with whole octaves: cactus of constant 0.01 19, 20, 22; bar of 0.2
35, 29, 44.)

docs/mathematics.md has what it gains. Where cells are stiff that is a third of the evaluations, and
its solve takes 2 to 4 times as long as that of A; so there A is used.
"""

import hashlib
from collections import defaultdict
from functools import partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, UInt32

from jaxdeform._deformation.local_step import LocalStep
from jaxdeform._deformation.system import System
from jaxdeform._linalg.cholesky import HostCholesky
from jaxdeform._linalg.ell import sparse_blocks
from jaxdeform._linalg.factor_cache import (
    HostFactor,
    Matrix,
    NotPositiveDefinite,
    factors,
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

Choice = Literal["auto", "material", "stiffness"]


class Metric(eqx.Module):
    """The factor of a metric, as a value: what it is made from, and the key of its content."""

    key: UInt32[Array, "4"]
    rigidity: Float[Array, "vertices"]


def metric_of(
    system: System, local: LocalStep, rigidity: Float[Array, "vertices"], choice: Choice = "auto"
) -> Metric | None:
    """Return the metric for the law of a local step at this rigidity; None for A.

    It is A too where factors are not on the host (on a GPU a new factor is expensive), and for laws
    that do not name their strain energy.
    """
    law = getattr(local, "strain_rigidity", None)
    if choice == "stiffness" or law is None or not isinstance(system.factor, HostCholesky):
        return None
    result = jax.ShapeDtypeStruct(system.factor.key.shape, np.uint32)
    system, rigidity = jax.lax.stop_gradient((system, law(rigidity)))
    always = jnp.asarray(choice == "material")
    return Metric(_key(result, always, rigidity, *_parts(system)), rigidity)


def apply_metric(
    system: System,
    metric: Metric | None,
    right: Float[Array, "3 vertices"],
    plain: Bool[Array, ""] | bool = False,
) -> Float[Array, "3 vertices"]:
    """Return H^-1 right at free vertices, 0 at others; with ``plain``, A^-1 right."""
    if metric is None:
        return system.factor.solve(right)
    columns = jnp.where(system.free[None], right, 0.0).T
    result = jax.ShapeDtypeStruct(columns.shape, columns.dtype)
    own = metric.key, jnp.asarray(plain), metric.rigidity
    return _solve(result, *own, *_parts(system), columns).T


def _parts(system: System) -> list[Array]:
    """Return all that a metric is made from but the rigidity."""
    return jax.tree.leaves((system.factor, system.principal_moments, system.covariance.forward))


# ---------------------------------------------------------------- on the host


class _Parts(NamedTuple):
    key: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    values: np.ndarray
    free: np.ndarray
    moments: np.ndarray
    covariance: list[np.ndarray]

    @staticmethod
    def of(arrays) -> "_Parts":
        key, starts, rows, values, free, moments, *covariance = arrays
        return _Parts(key, starts, rows, values, free, moments, covariance)

    @property
    def stiffness(self) -> Matrix:
        return Matrix(self.starts, self.rows, self.values, self.free)


def _key_on_host(out, *operands) -> None:
    """Return the key of the metric, or of A where that is as good; leading axes are members."""
    lead = out.ndim - 1
    own = [np.broadcast_to(x, (*out.shape[:-1], *x.shape[lead:])) for x in operands]
    for member in np.ndindex(out.shape[:-1]):
        always, rigidity, *arrays = (x[member] for x in own)
        parts = _Parts.of(arrays)
        usable = bool(np.isfinite(rigidity).all() and (rigidity >= 0).all())
        if usable and (always or _is_soft(rigidity, parts.moments)):
            digest = hashlib.blake2b(digest_size=16)
            rounded = _rounded_up(rigidity, parts.moments)
            for array in (rounded, parts.key, parts.moments, *parts.covariance):
                digest.update(np.ascontiguousarray(array).data)
            out[member] = np.frombuffer(digest.digest(), np.uint32)
        else:
            out[member] = parts.key


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


def _solve_on_host(out, *operands) -> None:
    """Solve for columns (..., n, 3). Members of a batch with the same factor go together."""
    *given, columns = operands
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
        packed = np.moveaxis(columns[which], 0, 1)
        solution = np.empty(packed.shape, out.dtype)
        flat = len(solution), -1
        one = [x[members[0]] for x in own]
        _solve_columns(solution.reshape(flat), one, packed.reshape(flat))
        out[which] = np.moveaxis(solution, 1, 0)


def _solve_columns(out, given, columns) -> None:
    key, plain, rigidity, *arrays = given
    if not key.any():
        out[...] = 0  # solvers that carry linear functions through loops begin with zeros
        return
    parts = _Parts.of(arrays)
    if plain or np.array_equal(key, parts.key):
        factor = factors.get(parts.key, parts.stiffness, columns.dtype)
    else:
        factor = factors.find(key, columns.dtype, partial(_make, rigidity, parts, columns.dtype))
    factor.solve(columns, out)


def _make(rigidity: np.ndarray, parts: _Parts, dtype: np.dtype) -> HostFactor:
    """Factor the metric, or A where that fails."""
    stiffness = _symmetric(parts.stiffness)
    pull = sp.vstack(sparse_blocks(*parts.covariance), format="csr").astype(np.float64)
    if dtype == np.float32:
        # Rows of K sum to 0: a translation pulls at nothing.
        n = len(parts.free)
        excess = np.asarray(pull.sum(axis=1)).ravel()
        pull = pull - sp.csr_matrix((excess, (np.arange(3 * n), np.tile(np.arange(n), 3))))
    inverse = compliance(parts.moments, _rounded_up(rigidity, parts.moments)).ravel()
    softened = pull.T @ sp.diags(inverse) @ pull
    for mix in _FLOAT32_MIXES if dtype == np.float32 else _MIXES:
        matrix = Matrix.of(stiffness - (1.0 - mix) * softened, parts.free)
        try:
            return HostFactor.of(matrix, dtype, shifts=(0.0,))
        except NotPositiveDefinite:
            continue
    return HostFactor.of(parts.stiffness, dtype)


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


_INTERFACE = installed_interface()
_key = HostFunction("jaxdeform_metric_key", _key_on_host, _INTERFACE)
_solve = HostFunction("jaxdeform_metric_solve", _solve_on_host, _INTERFACE)
