"""Misuse: its exception, words for its text, and the annotation of arguments checked by hand."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as ArrayLike
else:
    # The tests check annotations at every call. What a caller passes must reach the function's own
    # checks, which say what is wrong with it.
    ArrayLike = Any

_LONGEST = 1000


class InputError(ValueError):
    """Wrong input: names the vertex, face, file or argument, the reason, and the next move.

    The text is one line of bounded length. Control characters, which may come from a file, are
    shown as escapes, so that they never reach a terminal. For a wrong expression a note
    (``__notes__``, which Python prints below the text) shows the place by a caret.
    """

    def __init__(self, text: str = "") -> None:
        """Keep the text, made safe to print."""
        super().__init__(printable(text, _LONGEST))


def shown(value: Any) -> str:
    """Return one short line for any value, without control characters."""
    try:
        text = repr(value) if isinstance(value, str | bytes) else str(value)
    except ValueError:  # an integer of more than 4300 digits
        text = f"{a_or_an(value)} too long to print"
    text = printable(" ".join(text.split()))
    return text if len(text) <= 60 else f"{text[:57]}..."


def first_few(items: Sequence[object] | np.ndarray) -> str:
    """Return the first five, and three dots if there are more."""
    return ", ".join(map(str, items[:5])) + (", ..." if len(items) > 5 else "")


def have(name: str) -> str:
    """Return ``have`` after the name of many, ``has`` after that of one."""
    return "have" if name.endswith("s") else "has"


def number_of(count: int, one: str, many: str) -> str:
    """Return the count and its noun, that of one or that of many."""
    return f"{count} {one if count == 1 else many}"


def a_or_an(value: Any) -> str:
    """Return the type of a value, with its article."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIO' else 'a'} {name}"


def printable(text: str, longest: int | None = None) -> str:
    r"""Return the text with escapes for what no terminal should get, such as ``\x1b``.

    A longer text than ``longest`` loses its middle.
    """
    if longest is not None and len(text) > longest:
        text = f"{text[: longest - 300]} ... {text[-295:]}"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
