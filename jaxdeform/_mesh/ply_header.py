"""The header of a PLY file: which elements follow, with which properties."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdeform._errors import InputError
from jaxdeform._mesh.words import damaged, excerpt, whole

INTEGERS = {
    **dict.fromkeys((b"char", b"int8"), "i1"),
    **dict.fromkeys((b"uchar", b"uint8"), "u1"),
    **dict.fromkeys((b"short", b"int16"), "i2"),
    **dict.fromkeys((b"ushort", b"uint16"), "u2"),
    **dict.fromkeys((b"int", b"int32"), "i4"),
    **dict.fromkeys((b"uint", b"uint32"), "u4"),
    # Not in the format's first description, but programs write them.
    b"int64": "i8",
    b"uint64": "u8",
}
_KINDS = {
    **INTEGERS,
    **dict.fromkeys((b"float", b"float32"), "f4"),
    **dict.fromkeys((b"double", b"float64"), "f8"),
}


class Property(NamedTuple):
    """A number or a list of numbers that each record of an element has."""

    name: str
    kind: str
    """NumPy's name of the type, without the order of bytes."""
    count: str
    """The type of the length of a list; a single number has none."""
    line: int
    """Which line of the header tells of it."""


class Element(NamedTuple):
    """A table of a PLY file."""

    name: str
    count: int
    properties: list[Property]

    def names(self) -> list[str]:
        """Return the names of the properties."""
        return [item.name for item in self.properties]


@dataclass(frozen=True)
class Header:
    """What a PLY file announces."""

    encoding: str
    size: int
    """Length of the header in bytes: the body starts here."""
    line_end: bytes
    lines: list[bytes]
    elements: list[Element]

    @property
    def order(self) -> str:
        """NumPy's sign for the order of bytes; a text has none."""
        return {"binary_little_endian": "<", "binary_big_endian": ">"}.get(self.encoding, "")

    @property
    def vertex(self) -> Element:
        """The element of vertices, which every header has."""
        return next(element for element in self.elements if element.name == "vertex")

    def element(self, name: str) -> Element | None:
        """Return the element of this name."""
        return next((element for element in self.elements if element.name == name), None)


# A line end is CR LF, LF, or CR alone, as Rhino writes it. Then a body may start with the byte LF.
_END = re.compile(rb"[\r\n][ \t]*end_header[ \t]*(\r\n|\n|\r|\Z)", re.IGNORECASE)


def parse_header(path: Path, data: bytes) -> Header:
    """Read the header, or raise InputError."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data, re.IGNORECASE)
    end = _END.search(data)
    if not first or not end:
        raise damaged(path, "has no complete PLY header")
    line_end = first[1]
    size = end.start(1) + (1 if line_end == b"\r" else len(end[1]))
    lines = data[: end.start()].splitlines()
    encoding, elements = "", []
    try:
        for number, line in enumerate(lines):
            words = line.split()
            keyword = words[0].lower() if words else b""
            if keyword == b"format":
                encoding = words[1].decode("ascii", "replace").lower()
            elif keyword == b"element":
                elements.append(Element(_name(words[1]), whole(words[2]), []))
            elif keyword == b"property":
                elements[-1].properties.append(_property(path, words, number))
            elif keyword not in (b"", b"ply", b"comment", b"obj_info"):
                raise InputError(
                    f"{path}: line {number + 1} of its header begins with an unknown word: the "
                    "words are format, comment, element and property"
                )
    except (IndexError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise damaged(path, "has a PLY header without vertices and faces") from None
    header = Header(encoding, min(size, len(data)), line_end, lines, elements)
    _check(path, header)
    return header


def _name(word: bytes) -> str:
    return word.decode("utf-8", "backslashreplace")


def _property(path: Path, words: list[bytes], number: int) -> Property:
    def kind(word: bytes, known: dict[bytes, str]) -> str:
        if word.lower() not in known:
            raise InputError(
                f"{path}: line {number + 1} of its header {excerpt(words)} has the type "
                f"{excerpt([word])}, which cannot be read there: export it with "
                f"{'int or uchar' if known is INTEGERS else 'float, double or int'}"
            )
        return known[word.lower()]

    if words[1].lower() == b"list":
        count, item = kind(words[2], INTEGERS), kind(words[3], _KINDS)
        return Property(_name(words[4]), item, count, number)
    return Property(_name(words[2]), kind(words[1], _KINDS), "", number)


def _check(path: Path, header: Header) -> None:
    if header.encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise damaged(path, f"has the unknown PLY format '{header.encoding}'")
    vertex = header.element("vertex")
    if vertex is None:
        raise damaged(path, "has a PLY header without vertices and faces")
    if not {"x", "y", "z"} <= set(vertex.names()):
        raise damaged(path, "has a PLY header without positions x, y, z")
    if any(item.count for item in vertex.properties):
        raise InputError(f"{path}: its vertices have lists as properties: export it without them")
    for element in header.elements:
        names = element.names()
        if element.count < 0 or element.count >= np.iinfo(np.int64).max:
            raise damaged(path, f"announces {str(element.count)[:25]} of '{element.name}'")
        if len(set(names)) < len(names):
            raise damaged(path, f"has a property of '{element.name}' twice")
    names = [element.name for element in header.elements]
    if len(set(names)) < len(names):
        raise damaged(path, "has an element twice")


def with_property_lines(header: Header, types: dict[str, str], added: list[str]) -> Header:
    """Return a header whose vertices have other types of properties, and further properties."""
    lines = list(header.lines)
    for item in header.vertex.properties:
        if item.name in types:
            lines[item.line] = f"property {types[item.name]} {item.name}".encode()
    last = max(item.line for item in header.vertex.properties)
    lines[last + 1 : last + 1] = [f"property double {name}".encode() for name in added]
    return replace(header, lines=lines)


def header_bytes(header: Header) -> bytes:
    """Return the header as bytes."""
    return header.line_end.join([*header.lines, b"end_header", b""])
