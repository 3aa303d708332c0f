"""Refuse at once what is no local step, instead of failing deep inside compiled code."""

import inspect
from functools import cache

import jax
import jax.numpy as jnp

from jaxdeform._checks import check_setting
from jaxdeform._deformation.local_step import (
    LBFGS,
    AffineFit,
    GradientDescent,
    LocalStep,
    Newton,
    RotationFit,
)
from jaxdeform._errors import InputError

_OURS = (Newton, LBFGS, GradientDescent, RotationFit, AffineFit)
_METHODS = {
    "minimize": ("c", "b", "rigidity"),
    "with_implicit_derivative": ("t", "c", "b", "rigidity"),
    "energy": ("t", "c", "b", "rigidity"),
}


def check_local_step(local: object) -> None:
    """Raise InputError unless this is a local step that can be called."""
    if type(local) in _OURS:
        return
    name = type(local).__name__
    check_setting(
        "local",
        local,
        tuple(_METHODS),
        "a local step, such as jd.Newton(), or jd.RotationFit() for ARAP, or one of your own (see "
        "jd.LocalStep)",
    )
    for method, names in _METHODS.items():
        try:
            inspect.signature(getattr(local, method)).bind(*names)
        except TypeError as error:
            raise InputError(
                f"{name}.{method} cannot be called with ({', '.join(names)}): {error}; see "
                "jd.LocalStep"
            ) from error
    if not isinstance(local, _OURS):
        _check_what_it_returns(local, jnp.result_type(float))


@cache
def _check_what_it_returns(local: LocalStep, dtype) -> None:
    c, b, rigidity = (jax.ShapeDtypeStruct((*axes, 5), dtype) for axes in ((3, 3), (3,), ()))
    known = {"c": c, "t": c, "b": b, "rigidity": rigidity}
    for method, names in _METHODS.items():
        out = jax.eval_shape(getattr(local, method), *(known[name] for name in names))
        wanted = (5,) if method == "energy" else c.shape
        if getattr(out, "shape", None) != wanted or getattr(out, "dtype", None) != dtype:
            raise InputError(
                f"{type(local).__name__}.{method} returned {out} for 5 cells of {dtype}: return "
                f"one array of shape {wanted} and that type, the cells on the last axis"
            )
