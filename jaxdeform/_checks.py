"""Check arguments, or raise an InputError that names them, the reason, and the next move."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdeform._arrays import is_concrete, read_array, read_host_array, read_integers
from jaxdeform._errors import ArrayLike, InputError, a_or_an, shown

# ---------------------------------------------------------------- other types than arrays

# What to do with a value of another type. The key "" stands for all other types.
_INSTEAD = {
    "Mesh": {
        "path": "read it with jd.load_mesh(path)",
        "pair": "make one with jd.Mesh(vertices, faces)",
        "Problem": "give problem.mesh",
        "Cells": "give cells.mesh",
        "Submesh": "give submesh.mesh",
        "": "give a jd.Mesh: jd.Mesh(vertices, faces) makes one, jd.load_mesh(path) reads one",
    },
    "Cells": {
        "int": "give jd.rings(mesh, r)",
        "": "give jd.rings(mesh, r) or jd.spokes(mesh)",
    },
    "Problem": {
        "Mesh": "call jd.precompute(mesh, handles) first",
        "Cells": "call jd.precompute(cells.mesh, handles, cells=cells) first",
        "path": "call jd.precompute(jd.load_mesh(path), handles) first",
        "": "give what jd.precompute(mesh, handles) returns",
    },
    "Source": {
        "Mesh": "give mesh.source",
        "path": "give jd.load_mesh(path).source",
        "": "give mesh.source of a mesh that jd.load_mesh read, or None",
    },
}


def check_type(name: str, value: object, kind: type) -> None:
    """Raise InputError unless the value is of this type: it says what was given, what to give."""
    if isinstance(value, kind):
        return
    form = type(value).__name__
    if isinstance(value, str | os.PathLike):
        form = "path"
    elif isinstance(value, list | tuple) and len(value) == 2:
        form = "pair"
        if isinstance(value[0], kind):
            raise InputError(f"{name} is a pair: give its first entry, {shown(value[0])}")
    moves = _INSTEAD[kind.__name__]
    raise InputError(f"{name} is {a_or_an(value)}: {moves.get(form, moves[''])}")


def check_setting(name: str, value: object, methods: tuple[str, ...], example: str) -> None:
    """Raise InputError unless the value has these attributes and can be hashed."""
    if isinstance(value, str):
        raise InputError(f"{name} is the text {shown(value)}: give {example}")
    if isinstance(value, type):
        raise InputError(f"{name} is the class {value.__name__}: give {value.__name__}() instead")
    for method in methods:
        if not hasattr(value, method):
            raise InputError(f"{name} is {a_or_an(value)}, without {method}: give {example}")
    try:
        hash(value)
    except TypeError as error:
        raise InputError(
            f"{name} of type {type(value).__name__} is not hashable, so compiled code cannot be "
            "kept for it: make it a frozen dataclass with numbers for fields"
        ) from error


def read_path(name: str, value: str | os.PathLike[str] | Any) -> Path:
    """Return a path whose name the system can take, or raise InputError."""
    if not isinstance(value, str | os.PathLike) or isinstance(os.fspath(value), bytes):
        raise InputError(f"{name} is {a_or_an(value)}: give the name of a file, a str or a Path")
    try:
        if b"\0" in os.fsencode(value):
            raise InputError(f"{name} {shown(value)} holds a NUL character: give another name")
    except UnicodeEncodeError as error:
        raise InputError(f"{name} {shown(value)} cannot be encoded: give another name") from error
    return Path(value)


def check_function(name: str, value: Callable[..., Any] | Any | None, arguments: str) -> None:
    """Raise InputError unless the value can be called, or is None."""
    if value is not None and not callable(value):
        raise InputError(f"{name} is {a_or_an(value)}: give a function of ({arguments}), or None")


def check_count(name: str, value: Any, least: int = 1, most: int = 1_000_000) -> int:
    """Return a whole number within bounds, or raise InputError naming the setting."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        raise InputError(f"{name} is {shown(value)}: give a whole number from {least} to {most}")
    return int(value)


def check_tolerance(name: str, value: Any, *, positive: bool = False) -> float:
    """Return a finite number of 0 or more (or above 0), or raise InputError naming the setting."""
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not real or not 0 <= value <= sys.float_info.max or (positive and value == 0):
        bound = "above 0" if positive else "0 or more"
        raise InputError(f"{name} is {shown(value)}: give a finite number, {bound}")
    return float(value)


def check_flag(name: str, value: Any) -> bool:
    """Return True or False, or raise InputError naming the setting."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} is {shown(value)}: give True or False")
    return bool(value)


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """Raise InputError unless the value is one of these words."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name} is {shown(value)}: give one of {', '.join(map(repr, choices))}")


def check_precision(name: str, dtype: np.dtype) -> None:
    """Raise InputError for float64 numbers while JAX is set to float32."""
    if dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise InputError(
            f"{name} is float64, but jax_enable_x64 is off now: switch it on again, or make a new "
            f"{name}, which will be float32"
        )


# ---------------------------------------------------------------- arguments that many take


def check_positions(
    name: str, value: ArrayLike, shape: tuple[int, ...], dtype: np.dtype, unit: str = "vertex"
) -> Array:
    """Return a JAX array of this shape, or raise InputError; finite, if its values are known."""
    return jnp.asarray(read_positions(name, value, shape, dtype, unit))


def read_positions(
    name: str, value: ArrayLike, shape: tuple[int, ...], dtype: np.dtype, unit: str = "vertex"
) -> Array | np.ndarray:
    """Like `check_positions`, but without moving NumPy arrays to the device."""
    array = read_array(value, dtype, name)
    if array.shape != shape:
        raise InputError(f"{name} have shape {array.shape}, expected {shape}: one row per {unit}")
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


def rows_of_three(
    name: str, value: ArrayLike, dtype: np.dtype, unit: str = "vertex"
) -> Float[Array, "rows 3"]:
    """Return finite positions (rows, 3), at least one, or raise InputError naming the argument."""
    return jnp.asarray(_read_rows(name, read_array(value, dtype, name), unit))


def host_rows_of_three(name: str, value: ArrayLike) -> Float[np.ndarray, "rows 3"]:
    """Like `rows_of_three`, for code that NumPy runs, in float64."""
    return np.asarray(_read_rows(name, read_host_array(value, np.float64, name), "vertex"))


def _read_rows(name: str, array: Array | np.ndarray, unit: str) -> Array | np.ndarray:
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(
            f"{name} have shape {array.shape}: give one row (x, y, z) per {unit}, at least one"
        )
    return read_positions(name, array, array.shape, array.dtype, unit)


def check_index(
    name: str, given: Int[np.ndarray, "indices"], n: int, *, unit: str = "vertices"
) -> None:
    """Raise InputError unless all indices are within 0 to n - 1."""
    outside = np.flatnonzero((given < 0) | (given >= n))
    if outside.size:
        raise InputError(
            f"{name} {given[outside[0]]} (position {outside[0]}) is out of range: {unit} are 0 "
            f"to {n - 1}"
        )


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


def check_handle_weights(weights: ArrayLike, index: np.ndarray) -> np.ndarray:
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


def check_targets(targets: ArrayLike, count: int, dtype: np.dtype) -> Array | np.ndarray:
    """Return the targets as an array (handles, 3), or raise InputError naming what is wrong."""
    return read_positions("targets", targets, (count, 3), dtype, unit="handle")


def check_labels(
    name: str, value: ArrayLike, count: int, unit: str, end: int
) -> Int[np.ndarray, "labels"]:
    """Return one number from 0 to end - 1 per vertex or handle, or raise InputError.

    ``end`` keeps a number from reserving memory for all the smaller ones.
    """
    given = read_integers(value, name, f"give one integer per {unit}")
    if given.shape != (count,):
        raise InputError(
            f"{name} {'have' if name.endswith('s') else 'has'} shape {given.shape}: give one "
            f"integer per {unit}, ({count},)"
        )
    bad = np.flatnonzero((given < 0) | (given >= end))
    if bad.size:
        raise InputError(
            f"the {name.removesuffix('s')} of {unit} {bad[0]} is {given[bad[0]]}, out of range: "
            f"number from 0 to at most {end - 1}"
        )
    return given


def check_rigidity(
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
