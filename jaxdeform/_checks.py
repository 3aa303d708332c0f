"""Read arguments as arrays and check them, or raise an InputError that names them."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh


def is_concrete(x) -> bool:
    """Return whether the values of an array can be read now; while JAX traces they cannot."""
    return not isinstance(x, Tracer)


def as_array(value, dtype: np.dtype, name: str) -> Array:
    """Return the value as a JAX array, or raise InputError naming the argument."""
    return jnp.asarray(read_array(value, dtype, name))


def read_array(value, dtype: np.dtype, name: str) -> Array | np.ndarray:
    """Like :func:`as_array`, but validate without moving NumPy arrays to the device.

    A compiled function takes a NumPy array directly, 0.1 ms sooner than one that JAX is still
    copying.
    """
    try:
        if isinstance(value, np.ndarray | float | int) and np.asarray(value).dtype.kind in "iuf":
            with np.errstate(over="ignore"):  # overflow gives infinity, refused later
                return np.asarray(value, dtype)
        return jnp.asarray(value, dtype)
    except (TypeError, ValueError) as error:
        if isinstance(value, Tracer):
            raise
        raise InputError(f"{name} cannot be read as numbers: {error}") from error


def check_positions(name: str, value, shape: tuple, dtype: np.dtype, unit: str = "vertex") -> Array:
    """Return a JAX array of this shape, or raise InputError; finite, if its values are known."""
    return jnp.asarray(read_positions(name, value, shape, dtype, unit))


def read_positions(
    name: str, value, shape: tuple, dtype: np.dtype, unit: str = "vertex"
) -> Array | np.ndarray:
    """Like :func:`check_positions`, but without moving NumPy arrays to the device."""
    array = read_array(value, dtype, name)
    if array.shape != shape:
        raise InputError(f"{name} have shape {array.shape}, expected {shape}: one row per {unit}")
    if is_concrete(array):
        bad = np.flatnonzero(~np.isfinite(np.asarray(array)).reshape(shape[0], -1).all(axis=1))
        if bad.size:
            raise InputError(f"{name} of {unit} {bad[0]} are not finite: give finite numbers")
    return array


def check_handles(handles: ArrayLike, n: int) -> Int[np.ndarray, "handles"]:
    """Return the handle indices as an array, or raise InputError naming what is wrong."""
    given = np.asarray(handles)
    if given.ndim != 1:
        raise InputError(f"handles have shape {given.shape}: give one list of vertex indices")
    if given.size == 0:
        raise InputError("no handles: without one the mesh could lie anywhere; give at least one")
    if given.dtype.kind not in "iu":
        hint = ": use np.flatnonzero(mask)" if given.dtype == bool else ": give vertex indices"
        raise InputError(f"handles must be integers, got {given.dtype}{hint}")
    outside = np.flatnonzero((given < 0) | (given >= n))
    if outside.size:
        raise InputError(
            f"handle {given[outside[0]]} (position {outside[0]}) is out of range: vertices are 0 "
            f"to {n - 1}"
        )
    unique, count = np.unique(given, return_counts=True)
    if (count > 1).any():
        raise InputError(
            f"vertex {unique[count > 1][0]} is a handle {count.max()} times: list it once, because "
            "it can have only one target"
        )
    return given.astype(np.int64)


def check_handle_weights(weights: ArrayLike, index: np.ndarray) -> np.ndarray:
    """Return one weight per handle, infinite for a hard handle, or raise InputError."""
    given = np.asarray(weights, np.float64)
    if given.ndim and given.shape != index.shape:
        raise InputError(
            f"handle_weights have shape {given.shape}: give one number or one per handle, "
            f"{index.shape}"
        )
    given = np.broadcast_to(given, index.shape)
    bad = np.flatnonzero(~(given >= 0))
    if bad.size:
        raise InputError(
            f"the weight of handle {index[bad[0]]} is {given[bad[0]]}: give 0 or more, or np.inf "
            "to fix it"
        )
    return given


def check_components(mesh: Mesh, anchored: Int[np.ndarray, "anchored"]) -> None:
    """Raise InputError if a connected component of the mesh has no handle."""
    label = mesh.components
    loose = np.flatnonzero(mesh.referenced & ~np.isin(label, label[anchored]))
    if loose.size:
        k = int(loose[0])
        size = int((label == label[k]).sum())
        raise InputError(
            f"the connected component with vertex {k} ({size} vertices) has no handle, so it could "
            "lie anywhere: add a handle there, or drop the component"
        )


class HandleSplit(NamedTuple):
    """The vertices of a mesh, split into hard handles, soft handles and free vertices."""

    index: Int[np.ndarray, "handles"]
    """The handles, in the order given."""
    free: Bool[np.ndarray, "vertices"]
    """True for each vertex that is solved for: it has a face and is not a hard handle."""
    soft: Float[np.ndarray, "vertices"]
    """The weight of each soft handle; 0 elsewhere."""


def split_handles(mesh: Mesh, handles: ArrayLike, handle_weights: ArrayLike) -> HandleSplit:
    """Split the vertices into hard handles, soft handles and free vertices, or raise InputError."""
    index = check_handles(handles, mesh.n_vertices)
    weights = check_handle_weights(handle_weights, index)
    check_components(mesh, index[weights > 0])
    is_soft = np.isfinite(weights)
    free, soft = mesh.referenced.copy(), np.zeros(mesh.n_vertices)
    free[index[~is_soft]] = False
    soft[index[is_soft]] = weights[is_soft]
    return HandleSplit(index, free, soft)


def check_count(name: str, value: int, least: int = 1, most: int = 1_000_000) -> int:
    """Return a whole number within bounds, or raise InputError naming the setting."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        raise InputError(f"{name} is {value}: give a whole number from {least} to {most}")
    return int(value)


def check_tolerance(name: str, value: float) -> float:
    """Return a finite number of 0 or more, or raise InputError naming the setting."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or not 0 <= value < np.inf:
        raise InputError(f"{name} is {value}: give a finite number, 0 or more")
    return float(value)


def check_targets(targets: ArrayLike, count: int, dtype: np.dtype) -> Array | np.ndarray:
    """Return the targets as an array (handles, 3), or raise InputError naming what is wrong."""
    return read_positions("targets", targets, (count, 3), dtype, unit="handle")


def check_groups(group: ArrayLike, count: int) -> Int[np.ndarray, "handles"]:
    """Return one group number >= 0 per handle, or raise InputError naming what is wrong."""
    given = np.asarray(group)
    if given.shape != (count,) or given.dtype.kind not in "iu":
        raise InputError(
            f"group has shape {given.shape} and type {given.dtype}: give one integer per handle, "
            f"({count},)"
        )
    bad = np.flatnonzero(given < 0)
    if bad.size:
        raise InputError(f"the group of handle {bad[0]} is {given[bad[0]]}: number groups from 0")
    return given.astype(np.int64)


def check_rigidity(
    rigidity: ArrayLike, n: int, dtype: np.dtype, *, name: str = "rigidity"
) -> Float[Array, "vertices"] | Float[np.ndarray, "vertices"]:
    """Return the rigidity as one number per vertex, or raise InputError naming what is wrong."""
    array = read_array(rigidity, dtype, name)
    if array.shape not in ((), (n,)):
        raise InputError(
            f"{name} has shape {array.shape}: give one number, or one per vertex, ({n},)"
        )
    if is_concrete(array):
        values = np.atleast_1d(np.asarray(array))
        bad = np.flatnonzero(~((values >= 0) & np.isfinite(values)))
        if bad.size:
            where = f" at vertex {bad[0]}" if array.shape else ""
            raise InputError(
                f"{name} is {values[bad[0]]}{where}: it must be a finite number, 0 or more"
            )
    return (jnp if isinstance(array, Array) else np).broadcast_to(array, (n,))


def rows_of_three(name: str, value: ArrayLike, dtype: np.dtype) -> Float[Array, "rows 3"]:
    """Return finite positions (rows, 3), or raise InputError naming the argument."""
    array = as_array(value, dtype, name)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} have shape {array.shape}: give an array of shape (any, 3)")
    return check_positions(name, array, array.shape, dtype)
