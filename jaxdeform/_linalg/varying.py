"""Loops inside ``jax.shard_map``, which follows which values differ from device to device.

A loop's carry must begin with the types that it ends with. Zeros, which are the same on all
devices, do not: JAX asks for a cast. It means nothing anywhere else, and costs nothing.
"""

from typing import Any, TypeVar

import jax

from jaxdeform._arrays import is_concrete

T = TypeVar("T")


def as_varying(value: T, *others: Any) -> T:
    """Return a value that JAX takes to differ between devices where it, or one of ``others``, does.

    All are trees of arrays; the result is that of ``value``, leaf by leaf.
    """
    axes = frozenset[str]().union(*map(_axes, jax.tree.leaves((value, others))))
    if not axes:
        return value

    def cast(x: Any) -> Any:
        missing = tuple(sorted(axes - _axes(x)))
        return jax.lax.pcast(x, missing, to="varying") if missing else x

    return jax.tree.map(cast, value)


def _axes(x: Any) -> frozenset[str]:
    """Return the axes of the device mesh along which x differs."""
    if is_concrete(x):
        return frozenset()
    type_ = jax.typeof(x)
    kind = getattr(type_, "manual_axis_type", None)  # since JAX 0.10; before, only its first field
    return kind.varying if kind is not None else getattr(type_, "vma", frozenset())
