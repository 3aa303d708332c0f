"""Read arrays, or raise an InputError that names the argument, the reason, and the next move.

All arrays of all public functions come in here, so all of them refuse the same things. `read_array`
leaves JAX's as they are, for what may be traced. `read_host_array` returns NumPy's of a given type,
`read_numbers` of the type that they have.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int

from jaxdeform._errors import ArrayLike, InputError, a_or_an, shown

# NumPy's own limit. Lists that contain themselves have no end.
_MOST_AXES = 64

_BOOLEAN = (bool, np.bool_)
_NUMBER = (int, float, np.number, *_BOOLEAN)


def is_concrete(*trees) -> bool:
    """Return whether all numbers of these can be read now; while JAX traces they cannot."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def as_array(value: ArrayLike, dtype: np.dtype, name: str) -> Array:
    """Return the value as a JAX array, or raise InputError naming the argument."""
    return jnp.asarray(read_array(value, dtype, name))


def read_array(value: ArrayLike, dtype: np.dtype, name: str) -> Array | np.ndarray:
    """Return an array of this type: JAX's if the value is JAX's (also traced), else NumPy's.

    A compiled function takes a NumPy array directly, 0.1 ms sooner than one that JAX is still
    copying.
    """
    if type(value) is np.ndarray and value.dtype == dtype:
        return value
    if isinstance(value, jax.Array):
        _check_type(value.dtype, value, name)
        return jnp.asarray(value, dtype)
    leaves = _leaves(value, name)
    if hasattr(value, "__jax_array__") or any(isinstance(leaf, jax.Array) for leaf in leaves):
        for leaf in leaves:
            if not isinstance(leaf, int | float):
                _check_type(getattr(leaf, "dtype", np.dtype(object)), leaf, name)
        try:
            return jnp.asarray(value, dtype)
        except (TypeError, ValueError) as error:
            raise _unreadable(name, f"{error}: give an array of numbers") from error
    return _cast(_read_numpy(value, name), dtype)


def read_host_array(value: ArrayLike, dtype: np.dtype | type, name: str) -> np.ndarray:
    """Return a NumPy array of this type, for code that NumPy runs: nothing traced by JAX."""
    return _cast(read_numbers(value, name), np.dtype(dtype))


def read_numbers(value: ArrayLike, name: str) -> np.ndarray:
    """Return a NumPy array of booleans, integers or floats, of the type that was given."""
    if type(value) is np.ndarray and value.dtype.kind in "biuf":
        return value
    if isinstance(value, Tracer) or any(isinstance(x, Tracer) for x in _leaves(value, name)):
        raise InputError(
            f"{name}: traced by JAX (jit, vmap or grad), but this is computed in NumPy, without "
            "derivatives: give known numbers"
        )
    return _read_numpy(value, name)


def read_integers(
    value: ArrayLike, name: str, hint: str = "give vertex indices"
) -> Int[np.ndarray, "..."]:
    """Return whole numbers, of any sign, or raise InputError. An empty list is whole."""
    given = read_numbers(value, name)
    if given.size and given.dtype.kind not in "iu":
        whole = "integers" if given.ndim else "an integer"
        raise InputError(f"{name} must be {whole}, got {given.dtype}: {hint}")
    if given.size and given.dtype.kind == "u" and given.max() > np.iinfo(np.int64).max:
        raise InputError(f"{name}: {given.max()} is too large for an index: {hint}")
    return given.astype(np.int64)


def read_only(array: np.ndarray) -> np.ndarray:
    """Return the array, which cannot be written any more."""
    array.setflags(write=False)
    return array


def float_type(value: ArrayLike) -> np.dtype:
    """Return the type to compute in: the value's own up to 32 bits, else that of JAX's floats."""
    given = getattr(value, "dtype", None)
    if isinstance(given, np.dtype) and jnp.issubdtype(given, jnp.floating) and given.itemsize <= 4:
        return given.newbyteorder("=")
    return np.dtype(jnp.result_type(float))


def _leaves(value, name: str) -> list[Any]:
    """Return the entries of nested lists, unless one is odd among them; of anything else none."""
    leaves = list(value) if isinstance(value, list | tuple) else []
    for _ in range(_MOST_AXES):
        if not any(isinstance(x, list | tuple) for x in leaves):
            break
        leaves = [y for x in leaves for y in (x if isinstance(x, list | tuple) else (x,))]
    else:
        raise _unreadable(name, "its lists are too deep: give an array of numbers")
    for part in (value, *leaves):
        if isinstance(part, np.ma.MaskedArray) and np.ma.is_masked(part):
            raise _unreadable(
                name, "some entries are masked: give x.filled(number), or leave them out"
            )
    kinds = {isinstance(x, _BOOLEAN) for x in leaves if isinstance(x, _NUMBER)}
    if len(kinds) == 2:  # NumPy would take True for 1
        raise _unreadable(name, "it holds booleans among numbers: give numbers only")
    return leaves


def _read_numpy(value, name: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except Exception as error:  # whatever the __array__ of a foreign object raises
        raise _unreadable(name, f"{error}: give an array of numbers") from error
    _check_type(array.dtype, value, name)
    return array


def _check_type(dtype: Any, value, name: str) -> None:
    kind = getattr(dtype, "kind", "V")
    if kind in "biuf" or (kind == "V" and jnp.issubdtype(dtype, np.number)):  # such as bfloat16
        return
    given = f"is {a_or_an(value)}" if kind == "O" else f"is of type {dtype}"
    if kind == "O" and isinstance(value, list | tuple | np.ndarray):
        given = f"holds {_odd_entry(value)}"
    move = {
        "U": "it is text: give numbers",
        "S": "it is text: give numbers",
        "M": "it holds dates: give numbers",
        "m": "it holds durations: give numbers",
        "c": "it is complex: give its real part, x.real",
    }.get(kind, f"it {given}: give an array of numbers")
    raise _unreadable(name, move)


def _odd_entry(value) -> str:
    """Describe the first entry that is no number."""
    for entry in np.asarray(value, object).ravel().tolist():
        if isinstance(entry, int) and abs(entry) >= 2**63:
            return f"{shown(entry)}, which no array of whole numbers can hold"
        if not isinstance(entry, int | float | np.number):
            return a_or_an(entry)
    return "Python objects"


def _unreadable(name: str, reason: str) -> InputError:
    return InputError(f"{name} cannot be read as numbers: {' '.join(reason.split())}")


def _cast(array: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if array.dtype == dtype:
        return array
    with np.errstate(over="ignore", invalid="ignore"):  # overflow gives infinity, refused later
        return array.astype(dtype, copy=False)
