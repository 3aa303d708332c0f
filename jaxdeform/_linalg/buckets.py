"""Sizes of arrays, rounded up so that meshes of about one size share the compiled code.

XLA compiles for shapes, so a new mesh would cost seconds where the next size of a short series is
compiled already. What fills an array up is a vertex that no edge, face or handle touches: it is
fixed, its cell is empty, and it adds 0 to every sum.
"""

from typing import overload

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from jaxdeform._arrays import is_concrete
from jaxdeform._linalg.waiting import wait_for
from jaxdeform._linalg.xla import has_accelerator

# Four sizes a doubling: 10 % more vertices on average, 25 % at most.
_STEPS = 4
_LEAST = 64
# Rows of a multiple of 4 KiB fall on the same lines of a cache: 5,120 numbers a row cost 26 % more
# than 5,128.
_COLLIDING, _APART = 256, 8


def bucket(count: int) -> int:
    """Return the number of entries that arrays of so many vertices have."""
    count = max(count, _LEAST)
    octave = 1 << (count.bit_length() - 1)
    sizes = (octave * (_STEPS + k) // _STEPS for k in range(_STEPS + 1))
    apart = (x + _APART if x % _COLLIDING == 0 else x for x in sizes)
    return next(x for x in apart if x >= count)


def next_of(series: tuple[float, ...], value: float) -> float:
    """Return the first number of a rising series that is no less; it goes on by doubling."""
    found = next((x for x in series if x >= value), series[-1])
    while found < value:
        found *= 2
    return found


@overload
def fill_up(x: np.ndarray, size: int, value: float = ...) -> np.ndarray: ...
@overload
def fill_up(x: jax.Array, size: int, value: float = ...) -> np.ndarray | jax.Array: ...
@overload
def fill_up(x: np.ndarray | jax.Array, size: int, value: float = ...) -> np.ndarray | jax.Array: ...
def fill_up(x, size: int, value: float = 0.0):
    """Return an array with so many entries along its last axis, in NumPy unless JAX traces it."""
    missing = size - x.shape[-1]
    if not missing:
        return x
    widths = [(0, 0)] * (x.ndim - 1) + [(0, missing)]
    concrete = is_concrete(x)
    return (np if concrete else jnp).pad(
        np.asarray(x) if concrete else x, widths, constant_values=value
    )


def cut(x: jax.Array, count: int, axis: int = -1) -> jax.Array:
    """Return the first entries along an axis: without what fills the array up.

    On a CPU NumPy does it, once x is there, because JAX would compile a program for each mesh.
    """
    if x.shape[axis] == count:
        return x
    at = (*(slice(None),) * (axis % x.ndim), slice(count))
    if is_concrete(x) and not has_accelerator():
        return jax.device_put(np.asarray(wait_for(x))[at])
    return x[at]


def enlarge(matrix: sp.spmatrix, size: int, blocks: int = 1) -> sp.csr_matrix:
    """Return a square sparse matrix with empty rows and columns added to each of its blocks."""
    given = sp.csr_matrix(matrix, copy=True)
    n = matrix.shape[0] // blocks
    length = np.zeros((blocks, size), given.indptr.dtype)
    length[:, :n] = np.diff(given.indptr).reshape(blocks, n)
    starts = np.concatenate([given.indptr[:1], np.cumsum(length, dtype=length.dtype)])
    columns = given.indices + given.indices // max(n, 1) * (size - n)
    return sp.csr_matrix((given.data, columns, starts), shape=(blocks * size, blocks * size))
