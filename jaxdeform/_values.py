"""Read values that stand one per vertex or handle, or raise an InputError that names them."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdeform._arrays import is_concrete, read_array, read_host_array, read_integers
from jaxdeform._errors import ArrayLike, InputError, have, shown


def read_jax_positions(
    name: str, value: ArrayLike, shape: tuple[int, ...], dtype: np.dtype, unit: str = "vertex"
) -> Array:
    """Return a JAX array of this shape, or raise InputError; finite, if its values are known."""
    return jnp.asarray(read_positions(name, value, shape, dtype, unit))


def read_positions(
    name: str, value: ArrayLike, shape: tuple[int, ...], dtype: np.dtype, unit: str = "vertex"
) -> Array | np.ndarray:
    """Like `read_jax_positions`, but without moving NumPy arrays to the device."""
    array = read_array(value, dtype, name)
    if array.shape != shape:
        raise InputError(
            f"{name} {have(name)} shape {array.shape}, expected {shape}: one row per {unit}"
        )
    if is_concrete(array):
        finite = np.isfinite(np.asarray(array)).all(axis=tuple(range(1, array.ndim)))
        bad = np.flatnonzero(~finite)
        if bad.size:
            raise InputError(f"{name} of {unit} {bad[0]} are not finite: give finite numbers")
    return array


def read_host_positions(
    name: str, value: ArrayLike, shape: tuple[int, ...], unit: str = "vertex"
) -> np.ndarray:
    """Like `read_positions`, for code that NumPy runs, in float64."""
    given = read_host_array(value, np.float64, name)
    return np.asarray(read_positions(name, given, shape, given.dtype, unit))


def read_rows(
    name: str, value: ArrayLike, dtype: np.dtype, unit: str = "vertex"
) -> Float[Array, "rows 3"]:
    """Return finite positions (rows, 3), at least one, or raise InputError naming the argument."""
    return jnp.asarray(_checked_rows(name, read_array(value, dtype, name), unit))


def read_host_rows(name: str, value: ArrayLike) -> Float[np.ndarray, "rows 3"]:
    """Like `read_rows`, for code that NumPy runs, in float64."""
    return np.asarray(_checked_rows(name, read_host_array(value, np.float64, name), "vertex"))


def _checked_rows(name: str, array: Array | np.ndarray, unit: str) -> Array | np.ndarray:
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(
            f"{name} have shape {array.shape}: give one row (x, y, z) per {unit}, at least one"
        )
    return read_positions(name, array, array.shape, array.dtype, unit)


def read_axis(name: str, axis: str | ArrayLike) -> Float[np.ndarray, "3"]:
    """Return a unit vector from 'x', 'y', 'z' or a vector of any length, or raise InputError."""
    if isinstance(axis, str):
        if axis not in ("x", "y", "z"):
            raise InputError(
                f"{name} is {shown(axis)}: give 'x', 'y', 'z' or a vector of three numbers"
            )
        return np.eye(3)["xyz".index(axis)]
    vector = read_host_array(axis, np.float64, name)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise InputError(
            f"{name} is {shown(axis)}: give 'x', 'y', 'z' or a vector (3,) that is not zero"
        )
    # Scaled first: squares of 1e-200 vanish, those of 1e308 overflow.
    vector = np.ldexp(vector, -int(np.frexp(np.abs(vector).max())[1]))
    return vector / np.linalg.norm(vector)


def check_one_per_handle(weights: Any, shape: tuple[int, ...]) -> Any:
    """Return the weights, or raise InputError: not one number, nor as many as there are handles."""
    if weights.shape not in ((), shape):
        raise InputError(
            f"handle_weights have shape {weights.shape}: give one number or one per handle, {shape}"
        )
    return weights


def read_handle_weights(weights: ArrayLike, index: np.ndarray) -> np.ndarray:
    """Return one weight per handle, infinite for a hard handle, or raise InputError."""
    given = read_host_array(weights, np.float64, "handle_weights")
    given = np.broadcast_to(check_one_per_handle(given, index.shape), index.shape)
    bad = np.flatnonzero(~(given >= 0))
    if bad.size:
        raise InputError(
            f"the weight of handle {index[bad[0]]} is {given[bad[0]]}: give 0 or more, or np.inf "
            "to fix it"
        )
    return given


def read_labels(
    name: str, value: ArrayLike, count: int, unit: str, end: int
) -> Int[np.ndarray, "labels"]:
    """Return one number from 0 to end - 1 per vertex or handle, or raise InputError.

    ``end`` keeps a number from reserving memory for all the smaller ones.
    """
    given = read_integers(value, name, f"give one integer per {unit}")
    if given.shape != (count,):
        raise InputError(
            f"{name} {have(name)} shape {given.shape}: give one integer per {unit}, ({count},)"
        )
    bad = np.flatnonzero((given < 0) | (given >= end))
    if bad.size:
        raise InputError(
            f"the {name.removesuffix('s')} of {unit} {bad[0]} is {given[bad[0]]}, out of range: "
            f"number from 0 to at most {end - 1}"
        )
    return given


def read_rigidity(
    rigidity: ArrayLike,
    n: int,
    dtype: np.dtype,
    *,
    name: str = "rigidity",
    unit: str = "vertex",
    size: int | None = None,
) -> Float[Array, "vertices"] | Float[np.ndarray, "vertices"]:
    """Return the rigidity as one number per vertex, or raise InputError naming what is wrong.

    With a size, one number is spread over an array of that size.
    """
    array = read_array(rigidity, dtype, name)
    if array.shape not in ((), (n,)):
        raise InputError(
            f"{name} has shape {array.shape}: give one number, or one per {unit}, ({n},)"
        )
    if is_concrete(array):
        values = np.atleast_1d(np.asarray(array))
        bad = np.flatnonzero(~((values >= 0) & np.isfinite(values)))
        if bad.size:
            where = f" at {unit} {bad[0]}" if array.shape else ""
            raise InputError(
                f"{name} is {values[bad[0]]}{where}: it must be a finite number, 0 or more"
            )
    if array.ndim:
        return array
    return (jnp if isinstance(array, Array) else np).broadcast_to(array, (size or n,))
