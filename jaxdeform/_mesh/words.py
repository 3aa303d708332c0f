"""Words and numbers of text files, and what an error says of them."""

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxdeform._errors import InputError, shown

# Zeros, or the sign of DOS for the end, behind the end of a text, as old programs leave them.
PADDING = b"\0\x1a"

_WORD = re.compile(rb"[^\s\\]+")


def damaged(path: Path, what: str) -> InputError:
    """Return the error for a file that is not whole."""
    return InputError(f"{path}: {what}: the file is truncated or damaged; export it again")


def excerpt(line: bytes | list[bytes]) -> str:
    """Return the begin of a line of a file, for an error."""
    words = line.split() if isinstance(line, bytes) else line
    return shown(b" ".join(words[:20])[:60].decode("ascii", "replace"))


def real(word: bytes) -> float:
    """Return the number. Python alone would read ``1_0`` as 10."""
    if b"_" in word:
        raise ValueError
    return float(word)


def whole(word: bytes) -> int:
    """Return the integer. Python alone would read ``1_0`` as 10."""
    if b"_" in word:
        raise ValueError
    return int(word)


def content(line: bytes) -> list[bytes]:
    """Return the words of a line before its comment."""
    return line.split(b"#", 1)[0].split() if b"#" in line else line.split()


def position(path: Path, line: int, words: list[bytes]) -> tuple[float, float, float]:
    """Return the three coordinates at the begin of these words."""
    try:
        x, y, z = words[:3]
        if b"_" in x + y + z:
            raise ValueError
        return float(x), float(y), float(z)
    except ValueError:
        raise damaged(path, f"line {line} {excerpt(words)} is not a vertex") from None


def polygon(path: Path, where: str | int, words: list[bytes]) -> list[int]:
    """Return the corners from words of the form ``n i j k ...``."""
    if isinstance(where, int):
        where = f"line {where}"
    try:
        size = whole(words[0])
        part = words[1 : 1 + size] if size > 0 else []
        if b"_" in b"".join(part):  # once a line, because files are long
            raise ValueError
        corners = list(map(int, part))
    except (ValueError, IndexError):
        raise damaged(path, f"{where} {excerpt(words)} is not a face") from None
    if size < 3:
        raise damaged(path, f"{where} is a face with {size} corners")
    if len(corners) < size:
        raise damaged(path, f"{where} {excerpt(words)} is not a face")
    return corners


def stacked(points: Sequence[tuple[float, ...]]) -> Float[np.ndarray, "points 3"]:
    """Return the points as an array, also if there are none."""
    return np.array(points, np.float64).reshape(-1, 3)


def text_of(row: Sequence[float]) -> list[bytes]:
    """Return the shortest text of each number that keeps every bit."""
    return [repr(value).encode() for value in row]


def with_words(line: bytes, start: int, words: list[bytes]) -> bytes:
    """Return a line with some of its words replaced. Its white space and its end stay.

    A word ends at a backslash, which continues a line of OBJ.
    """
    out, at = [], 0
    found = islice(_WORD.finditer(line), start, start + len(words))
    for old, new in zip(found, words, strict=False):
        out += [line[at : old.start()], new]
        at = old.end()
    return b"".join(out) + line[at:]


def joined(lines: list[str]) -> bytes:
    """Return the lines as the content of a file."""
    return ("\n".join(lines) + "\n").encode()
