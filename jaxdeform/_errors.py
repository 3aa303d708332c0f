"""Misuse: its exception, and the annotation of arguments that are checked by hand."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as ArrayLike
else:
    # The tests check annotations at every call. What a caller passes must reach the function's own
    # checks, which say what is wrong with it.
    ArrayLike = Any


class InputError(ValueError):
    """Wrong input: names the vertex, face, file or argument, the reason, and the next move."""
