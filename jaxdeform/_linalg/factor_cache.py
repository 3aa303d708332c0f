"""Cholesky factors of this process, found by the content of their matrix.

Together they take at most 2 GiB, or the number of bytes in the environment variable
JAXDEFORM_FACTOR_BYTES. A factor that had to go is made again when it is needed.
"""

import atexit
import hashlib
import math
import os
import threading
import weakref
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from cholespy import CholeskySolverD, CholeskySolverF, MatrixType  # pyright: ignore[reportAttributeAccessIssue]
from jaxtyping import Array, Bool, Float, Int32, UInt32

from jaxdeform._linalg.buckets import fill_up, next_of

# The diagonal of a matrix that only gives a first guess is raised by these parts of itself, one
# after another, until there is a factor: rounding makes L^T L indefinite where triangles are flat.
SHIFTS = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)

# Entries of the lower triangle for each unknown: closed meshes have just below 4, their L^T L 7 to
# 11.
_ENTRIES = (4.25, 12.0, 16.0, 24.0)

# What all factors of a process may take together. The one made last stays in any case.
CAPACITY = int(os.environ.get("JAXDEFORM_FACTOR_BYTES", 2 << 30))
# What those may take that no problem owns, the last two aside: those of problems that are gone, and
# all metrics (metric_factor.py). They are not freed at once, because JAX does not wait: a
# deformation may still run when its problem has been collected.
_UNOWNED = 64 << 20
# A factor takes 5 to 8.4 bytes for each entry of the lower triangle times log2 n (measured for
# both matrices of 722, 4,802 and 50,298 vertices); the copy of the matrix beside it takes 12.
_FACTOR_BYTES, _MATRIX_BYTES = 8.5, 12


class NotPositiveDefinite(ValueError):
    """The matrix of the free vertices has no Cholesky factor."""


class Matrix(NamedTuple):
    """A symmetric matrix (vertices, vertices) and which of its unknowns are free, as exact arrays.

    Of the lower triangle, column by column, the whole diagonal and what is not zero below it.
    """

    starts: Int32[np.ndarray, "columns"]
    """Where the entries of each column begin, and the end of the last: n + 1."""
    rows: Int32[np.ndarray, "entries"]
    values: UInt32[np.ndarray, "entries 2"]
    """The bits of the float64 values. As numbers JAX would round them to float32 where it is not
    set to float64; and L^T L in float32 is often not positive definite."""
    free: Bool[np.ndarray, "vertices"]

    @staticmethod
    def of(matrix: sp.spmatrix, free: Bool[np.ndarray, "vertices"]) -> "Matrix":
        """Take the lower triangle of a sparse matrix."""
        n = matrix.shape[0]
        below, diagonal = sp.coo_matrix(sp.tril(matrix, -1)), np.arange(n)
        entries = np.concatenate([sp.csr_matrix(matrix).diagonal(), below.data]).astype(np.float64)
        i, j = np.concatenate([diagonal, below.row]), np.concatenate([diagonal, below.col])
        lower = sp.csc_matrix((entries, (i, j)), shape=(n, n))
        lower.sort_indices()
        starts, rows = lower.indptr.astype(np.int32), lower.indices.astype(np.int32)
        return Matrix(starts, rows, lower.data.view(np.uint32).reshape(-1, 2), np.array(free))

    def key(self) -> UInt32[np.ndarray, "4"]:
        """Return a hash of the content."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(np.array([len(self.free), len(self.rows)], np.int64).data)
        for part in self:
            digest.update(np.ascontiguousarray(part).data)
        return np.frombuffer(digest.digest(), np.uint32)

    def equals(self, other: "Matrix") -> bool:
        """Whether all entries are the same, bit by bit."""
        pairs = list(zip(self, other, strict=True))
        return all(a.shape == b.shape for a, b in pairs) and all((a == b).all() for a, b in pairs)

    def filled_up(self, first: bool) -> "Matrix":
        """Return the matrix with room for the entries of every mesh of its bucket (buckets.py).

        ``first``: it is for a first guess, and so L^T L.
        """
        n, count = len(self.free), len(self.rows)
        size = math.ceil(next_of(_ENTRIES[first:], count / max(n, 1)) * n)
        rows, values = fill_up(self.rows, size), fill_up(self.values.T, size).T
        return self._replace(rows=rows, values=np.ascontiguousarray(values))

    @property
    def entries(self) -> tuple[Int32[np.ndarray, "entries"], Float[np.ndarray, "entries"]]:
        """The rows and the values, without what fills them up."""
        count = self.starts[-1]
        return self.rows[:count], self.values.reshape(-1).view(np.float64)[:count]

    def inner(self) -> sp.csc_matrix:
        """Return the lower triangle, with the rows and columns of fixed unknowns the identity's.

        So nobody has to pick the free entries of a right-hand side, and the factor is no larger.
        """
        n, (rows, values) = len(self.free), self.entries
        columns = np.repeat(np.arange(n, dtype=np.int32), np.diff(self.starts))
        free = self.free[columns] & self.free[rows]
        kept = (columns == rows) | free
        values = np.where(free, values, 1.0)[kept]
        return sp.csc_matrix((values, (rows[kept], columns[kept])), shape=(n, n))


def cholesky(lower: sp.csc_matrix, dtype: np.dtype, shifts: tuple[float, ...]) -> Any:
    """Return CHOLMOD's simplicial factor of a matrix, given its lower triangle and diagonal.

    **Raises** NotPositiveDefinite.
    """
    lower.sort_indices()
    kind = CholeskySolverF if dtype == np.float32 else CholeskySolverD
    starts, rows = lower.indptr.astype(np.int32), lower.indices.astype(np.int32)
    for shift in shifts:
        values = lower.data.copy()
        values[starts[:-1]] *= 1.0 + shift
        try:
            return kind(len(starts) - 1, starts, rows, values, MatrixType.CSC)
        except ValueError:
            continue
    raise NotPositiveDefinite(
        "the system of the free vertices is not positive definite: the mesh spans too many orders "
        "of magnitude; see jd.inspect(mesh) and jd.repair(mesh)"
    )


class HostFactor(NamedTuple):
    """A factor of this process."""

    matrix: Matrix
    """A copy of what was factored."""
    solver: Any
    lock: threading.Lock
    """CHOLMOD's workspace belongs to the factor."""

    @staticmethod
    def of(matrix: Matrix, dtype: np.dtype, shifts: tuple[float, ...] = SHIFTS) -> "HostFactor":
        """Factor a matrix. **Raises** NotPositiveDefinite."""
        solver = cholesky(matrix.inner(), dtype, shifts)
        return HostFactor(Matrix(*(np.array(x) for x in matrix)), solver, threading.Lock())

    @property
    def size(self) -> int:
        """What it takes, in bytes, as estimated."""
        entries, n = len(self.matrix.rows), len(self.matrix.free)
        return int(entries * (_FACTOR_BYTES * np.log2(n + 1) + _MATRIX_BYTES))

    def solve(self, right: np.ndarray, out: np.ndarray) -> None:
        """Solve for columns (n, k), of any layout and number."""
        if right.size:
            right = np.require(right, requirements=["C", "W"])
            with self.lock:
                self.solver.solve(right, out)


class _Entry:
    def __init__(self) -> None:
        self.factor: Future[HostFactor] = Future()
        self.size = 0
        self.unowned = False


class FactorCache:
    """Factors by the key of their matrix and their precision, those used last at the end.

    Any number of threads may ask at once: one makes a factor, those that want the same one wait.
    """

    def __init__(self, capacity: int) -> None:
        """Set what all factors may take together, in bytes."""
        self.capacity = capacity
        self._entries: OrderedDict[tuple[bytes, str], _Entry] = OrderedDict()
        self._owners: Counter[bytes] = Counter()
        self._collected: deque[bytes] = deque()
        self._lock = threading.Lock()

    def get(
        self,
        key: UInt32[np.ndarray, "4"],
        matrix: Matrix,
        dtype: np.dtype,
        shifts: tuple[float, ...] = SHIFTS,
    ) -> HostFactor:
        """Return the factor of a matrix, whose hash is the key, made where it is missing.

        **Raises** NotPositiveDefinite, and ValueError where key and matrix do not belong together.
        """

        def make() -> HostFactor:
            if not np.array_equal(matrix.key(), key):
                raise mixed_up()
            return HostFactor.of(matrix, dtype, shifts)

        factor = self.find(key, dtype, make)
        if not factor.matrix.equals(matrix):
            raise mixed_up()
        return factor

    def find(
        self, key: UInt32[np.ndarray, "4"], dtype: np.dtype, make: Callable[[], HostFactor]
    ) -> HostFactor:
        """Return the factor of this key, made where it is missing."""
        name = key.tobytes(), dtype.char
        with self._lock:
            entry = self._entries.get(name)
            missing = entry is None
            if entry is None:
                entry = self._entries[name] = _Entry()
                entry.unowned = key.tobytes() not in self._owners
            self._entries.move_to_end(name)
        if missing:
            self._make(name, entry, make)
        return entry.factor.result()

    def own(self, key: UInt32[np.ndarray, "4"], owner: Array) -> None:
        """Let the factors of this key go some time after the owner is collected."""
        name = key.tobytes()
        with self._lock:
            self._owners[name] += 1
            for entry in self._of(name):
                entry.unowned = False
        # The collector may run anywhere, also in a thread that has the lock: so it only notes.
        weakref.finalize(owner, self._collected.append, name).atexit = False

    @property
    def size(self) -> int:
        """What all factors take together, as estimated."""
        with self._lock:
            return sum(entry.size for entry in self._entries.values())

    def clear(self) -> None:
        """Let go of all factors."""
        with self._lock:
            self._entries.clear()

    def _make(self, name, entry: _Entry, make: Callable[[], HostFactor]) -> None:
        try:
            factor = make()
        except BaseException as error:
            with self._lock:
                self._entries.pop(name, None)
            entry.factor.set_exception(error)
            raise
        with self._lock:
            entry.size = factor.size
            if name in self._entries:
                self._free_some(name)
        entry.factor.set_result(factor)

    def _of(self, key: bytes) -> list[_Entry]:
        return [self._entries[key, c] for c in "fd" if (key, c) in self._entries]

    def _free_some(self, made) -> None:
        while self._collected:
            key = self._collected.popleft()
            self._owners[key] -= 1
            if not self._owners[key]:
                del self._owners[key]
                for entry in self._of(key):
                    entry.unowned = True
        rest = [x for x, entry in self._entries.items() if x != made and entry.factor.done()]
        unowned = [x for x in rest if self._entries[x].unowned]
        self._shrink(unowned, _UNOWNED, least=2)
        rest = sorted((x for x in rest if x in self._entries), key=lambda x: x not in unowned)
        self._shrink(rest, self.capacity - self._entries[made].size, least=0)

    def _shrink(self, names: list[Any], limit: int, least: int) -> None:
        total = sum(self._entries[x].size for x in names)
        for name in names[: len(names) - least]:
            if total <= limit:
                break
            total -= self._entries.pop(name).size


def mixed_up() -> ValueError:
    """Return the error for a key and a matrix that do not belong together."""
    return ValueError(
        "the arrays of this factor do not belong together: some were changed or come from another "
        "problem. Make the problem anew with precompute"
    )


factors = FactorCache(CAPACITY)
# nanobind would call them leaked. Programs have ended then: host_call.py, imported later, is asked
# earlier.
atexit.register(factors.clear)
