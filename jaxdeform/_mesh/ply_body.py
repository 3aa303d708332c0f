"""The body of a PLY file: where each value of each record lies."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxdeform._mesh.ply_header import Element, Header
from jaxdeform._mesh.words import damaged, whole


class Field(NamedTuple):
    """Where the values of one property lie in a binary body."""

    offsets: Int[np.ndarray, "records"]
    sizes: Int[np.ndarray, "records"]
    dtype: np.dtype

    def take(self, data: bytes) -> np.ndarray:
        """Return all values, one record after another."""
        begin = np.repeat(self.offsets, self.sizes)
        within = np.arange(len(begin)) - np.repeat(np.cumsum(self.sizes) - self.sizes, self.sizes)
        places = (begin + within * self.dtype.itemsize)[:, None] + np.arange(self.dtype.itemsize)
        return np.frombuffer(data, np.uint8)[places].view(self.dtype).reshape(-1)

    def put(self, data: bytearray, values: np.ndarray) -> None:
        """Write one value per record."""
        places = self.offsets[:, None] + np.arange(self.dtype.itemsize)
        content = np.ascontiguousarray(values.astype(self.dtype)).view(np.uint8)
        np.frombuffer(data, np.uint8)[places] = content.reshape(places.shape)


def binary_fields(
    path: Path, data: bytes, header: Header
) -> tuple[dict[tuple[str, str], Field], int]:
    """Return the fields by (element, property), and where the body ends."""
    at = header.size
    fields: dict[tuple[str, str], Field] = {}
    for element in header.elements:
        found, at = _fields(path, data, at, element, header.order)
        fields |= {(element.name, name): field for name, field in found.items()}
    return fields, at


def _fields(
    path: Path, data: bytes, at: int, element: Element, order: str
) -> tuple[dict[str, Field], int]:
    if not element.properties or not element.count:
        empty = np.empty(0, np.int64)
        names = {item.name: np.dtype(order + item.kind) for item in element.properties}
        return {name: Field(empty, empty, dtype) for name, dtype in names.items()}, at
    # Most often the lists of all records are as long as those of the first.
    first, end = _walk(path, data, at, element, order, 1)
    length = end - at
    if element.count * length <= len(data) - at:
        step = np.arange(element.count) * length
        same = True
        for item in element.properties:
            if item.count:
                width = int(item.count[1])
                places = first[item.name].offsets[0] - width + step
                count = Field(places, np.ones_like(places), np.dtype(order + item.count))
                same = same and bool((count.take(data) == first[item.name].sizes[0]).all())
        if same:
            fields = {
                name: Field(offsets[0] + step, np.repeat(sizes, element.count), dtype)
                for name, (offsets, sizes, dtype) in first.items()
            }
            return fields, at + element.count * length
    elif not any(item.count for item in element.properties):
        raise _short(path, element)
    return _walk(path, data, at, element, order, element.count)


def _walk(
    path: Path, data: bytes, at: int, element: Element, order: str, count: int
) -> tuple[dict[str, Field], int]:
    """Go from record to record."""
    byteorder = "little" if order == "<" else "big"
    kinds = [
        (int(item.count[1]) if item.count else 0, item.count[:1] == "i", int(item.kind[1]))
        for item in element.properties
    ]
    offsets: list[list[int]] = [[] for _ in kinds]
    sizes: list[list[int]] = [[] for _ in kinds]
    for record in range(count):
        for (width, signed, itemsize), places, lengths in zip(kinds, offsets, sizes, strict=True):
            size = 1
            if width:
                size = int.from_bytes(data[at : at + width], byteorder, signed=signed)
                at += width
                if size < 0:
                    raise damaged(path, f"'{element.name}' {record} has a list of length {size}")
            places.append(at)
            lengths.append(size)
            at += size * itemsize
        if at > len(data):
            raise _short(path, element)
    fields = {
        item.name: Field(np.array(places), np.array(lengths), np.dtype(order + item.kind))
        for item, places, lengths in zip(element.properties, offsets, sizes, strict=True)
    }
    return fields, at


def _short(path: Path, element: Element) -> Exception:
    return damaged(
        path, f"is shorter than its header announces ({element.count} of '{element.name}')"
    )


class TextRows(NamedTuple):
    """The lines of a text body."""

    lines: list[bytes]
    """One record each."""
    rows: dict[str, list[int]]
    """Which lines each element has."""
    behind: list[int]
    """The lines behind the end."""


def text_rows(path: Path, data: bytes, header: Header, keepends: bool = False) -> TextRows:
    """Return the lines of the body. Where records are not one a line, they are put so."""
    lines = data[header.size :].splitlines(keepends)
    filled = [k for k, line in enumerate(lines) if line.strip()]
    counts = [element.count if element.properties else 0 for element in header.elements]
    if not _fill_lines(lines, filled, header):
        flowing = _one_a_line(data, header)
        if flowing:
            lines, filled = flowing, list(range(len(flowing)))
    rows: dict[str, list[int]] = {}
    at = 0
    for element, count in zip(header.elements, counts, strict=True):
        rows[element.name] = filled[at : at + count]
        at += count
        if at > len(filled):
            raise damaged(path, f"announces {count} of '{element.name}' but holds fewer")
    return TextRows(lines, rows, filled[at:])


def _fill_lines(lines: list[bytes], filled: list[int], header: Header) -> bool:
    """Return whether there is a line for each record, with as many words as it needs."""
    at = 0
    try:
        for element in header.elements:
            count = element.count if element.properties else 0
            if at + count > len(filled):
                return False
            for k in filled[at : at + count]:
                words = lines[k].split()
                if text_place(words, element, "") > len(words):
                    return False
            at += count
    except (ValueError, IndexError):
        return False
    return True


def _one_a_line(data: bytes, header: Header) -> list[bytes] | None:
    """Return the records of a body, a line each, or None: its words are not just those records."""
    words = data[header.size :].split()
    lines, at = [], 0
    try:
        for element in header.elements:
            for _ in range(element.count if element.properties else 0):
                begin = at
                for item in element.properties:
                    at += 1 + max(whole(words[at]), 0) if item.count else 1
                if at > len(words):
                    return None
                lines.append(b" ".join(words[begin:at]) + header.line_end)
    except (ValueError, IndexError):
        return None
    return lines if at == len(words) else None


def text_place(words: list[bytes], element: Element, name: str) -> int:
    """Return which word of a line begins a property, or raise ValueError or IndexError.

    Without such a property it is the number of words that all of them take.
    """
    at = 0
    for item in element.properties:
        if item.name == name:
            break
        at += 1 + max(whole(words[at]), 0) if item.count else 1
    return at
