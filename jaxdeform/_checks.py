"""Check arguments, or raise an InputError that names them, the reason, and the next move."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxdeform._errors import InputError, a_or_an, shown

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
