"""Numbers of a solver and of an adjoint, which the compiled code takes as arguments.

Another tolerance then compiles nothing anew. (The most steps of a solver are as many as its
history of energies is long: other arrays, another program.)
"""

import copy
from typing import Any, TypeVar

import numpy as np

Setting = TypeVar("Setting")
Numbers = dict[str, Any]


def numbers_of(setting: Any, dtype: np.dtype) -> Numbers:
    """Return the numbers of a setting, in the precision of the problem.

    Its class names them. A derived class may read them in Python, so it has none.
    """
    kinds: dict[str, type] = vars(type(setting)).get("numbers", {})
    given = {name: getattr(setting, name) for name in kinds}
    return {
        name: np.asarray(x, dtype if kinds[name] is float else np.int32)
        for name, x in given.items()
        if x is not None
    }


def without_numbers(setting: Setting, numbers: Numbers) -> Setting:
    """Return a setting as it is compiled for: like all that have other numbers."""
    return with_numbers(setting, dict.fromkeys(numbers))


def with_numbers(setting: Setting, numbers: Numbers) -> Setting:
    """Return a setting with these numbers, which may be traced, so that nothing checks them."""
    if not numbers:
        return setting  # of another class it may be equal to nothing but itself
    changed = copy.copy(setting)
    for name, value in numbers.items():
        object.__setattr__(changed, name, value)
    return changed
