"""Misuse: its exception, words for its text, and the annotation of arguments checked by hand."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as ArrayLike
else:
    # The tests check annotations at every call. What a caller passes must reach the function's own
    # checks, which say what is wrong with it.
    ArrayLike = Any


class InputError(ValueError):
    """Wrong input: names the vertex, face, file or argument, the reason, and the next move."""


def shown(value) -> str:
    """Return one short line for any value."""
    try:
        text = repr(value) if isinstance(value, str | bytes) else str(value)
    except ValueError:  # an integer of more than 4300 digits
        text = a_or_an(value)
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def a_or_an(value) -> str:
    """Return the type of a value, with its article."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIO' else 'a'} {name}"
