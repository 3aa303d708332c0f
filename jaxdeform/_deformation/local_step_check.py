"""Refuse at once what is no local step, instead of failing deep inside compiled code."""

import inspect
from functools import cache
from typing import cast

import jax
import numpy as np
from jaxtyping import Array

from jaxdeform._checks import check_setting
from jaxdeform._deformation.local_step import (
    LBFGS,
    AffineFit,
    GradientDescent,
    LocalStep,
    Newton,
    RotationFit,
)
from jaxdeform._errors import InputError, a_or_an

_OURS = (Newton, LBFGS, GradientDescent, RotationFit, AffineFit)
_METHODS = {
    "minimize": ("c", "b", "rigidity"),
    "with_implicit_derivative": ("t", "c", "b", "rigidity"),
    "energy": ("t", "c", "b", "rigidity"),
}


def check_local_step(local: object, dtype: np.dtype) -> None:
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
    for method, names in _methods(local).items():
        try:
            inspect.signature(getattr(local, method)).bind(*names)
        except TypeError as error:
            raise InputError(
                f"{name}.{method} cannot be called with ({', '.join(names)}): {error}; see "
                "jd.LocalStep"
            ) from error
    _check_what_it_returns(cast(LocalStep, local), dtype)


def _methods(local: object) -> dict[str, tuple[str, ...]]:
    """Return the arguments of each method; the one that may be missing, if it is there."""
    optional = {"strain_rigidity": ("rigidity",)} if hasattr(local, "strain_rigidity") else {}
    return _METHODS | optional


@cache
def _check_what_it_returns(local: LocalStep, dtype: np.dtype) -> None:
    c, b, rigidity = (jax.ShapeDtypeStruct((*axes, 5), dtype) for axes in ((3, 3), (3,), ()))
    known = {"c": c, "t": c, "b": b, "rigidity": rigidity}
    for method, names in _methods(local).items():
        wanted = c.shape if method in ("minimize", "with_implicit_derivative") else (5,)

        def call(*given, method=method, wanted=wanted):
            out = getattr(local, method)(*given)
            kind = f"{out.dtype}{list(out.shape)}" if isinstance(out, Array) else a_or_an(out)
            if kind != f"{dtype}{list(wanted)}":
                raise InputError(
                    f"{type(local).__name__}.{method} returned {kind} for 5 cells of {dtype}: "
                    f"return one array of shape {wanted} and that type, the cells on the last axis"
                )
            return out

        jax.eval_shape(call, *(known[name] for name in names))
