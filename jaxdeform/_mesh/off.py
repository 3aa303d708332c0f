"""OFF files (Geomview): read, write, and rewrite with other positions."""

import re
from pathlib import Path

import numpy as np

from jaxdeform._errors import InputError
from jaxdeform._mesh.normals import vertex_normals
from jaxdeform._mesh.parsed import Extras, Parsed
from jaxdeform._mesh.polygons import Polygons, from_lists
from jaxdeform._mesh.words import (
    content,
    damaged,
    excerpt,
    joined,
    polygon,
    position,
    real,
    stacked,
    text_of,
    whole,
    with_words,
)

# COFF, NOFF and the like add normals or colours after the position. 4OFF changes the position.
_FIRST_WORD = re.compile(rb"(ST)?(C?)(N?)OFF", re.IGNORECASE)


def parse_off(path: Path, data: bytes) -> Parsed:
    """Read positions and polygons."""
    lines = _records(data)
    filled = _filled(lines)
    first = content(lines[filled[0]]) if filled else [b""]
    if not _FIRST_WORD.fullmatch(first[0]):
        raise InputError(f"{path}: does not start with OFF: check that it is an OFF file")
    if first[1:2] and first[1].lower() == b"binary":
        raise InputError(f"{path}: is a binary OFF file: export it as text")
    begin = _body(lines, filled)
    head = _head(lines, filled)
    try:
        n, m = whole(head[0]), whole(head[1])
    except (IndexError, ValueError):
        raise damaged(path, "has no counts of vertices and faces") from None
    body = filled[begin:]
    if not 0 <= n + m <= len(body) or min(n, m) < 0:
        raise damaged(path, f"announces {excerpt(head)} vertices and faces but holds fewer")
    points = [position(path, k + 1, content(lines[k])) for k in body[:n]]
    sizes: list[int] = []
    corners: list[int] = []
    for k in body[n : n + m]:
        face = polygon(path, k + 1, content(lines[k]))
        sizes.append(len(face))
        corners += face
    trailing = sum(len(lines[k]) for k in body[n + m :])
    try:
        return Parsed(stacked(points), from_lists(sizes, corners), trailing)
    except OverflowError:
        raise damaged(path, "names a vertex out of range") from None


def to_off(points: np.ndarray, polygons: Polygons, extras: Extras) -> bytes:
    """Return the content of a file; colours are bytes, as MeshLab, CGAL and Open3D write them."""
    colors = extras.colors
    lines = ["OFF" if colors is None else "COFF", f"{len(points)} {len(polygons.sizes)} 0"]
    rows = [f"{x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    if colors is not None:
        shades = np.rint(255 * colors).astype(int).tolist()
        rows = [f"{row} {r} {g} {b} 255" for row, (r, g, b) in zip(rows, shades, strict=True)]
    lines += rows
    corners = list(map(str, polygons.corners.tolist()))
    at = 0
    for size in polygons.sizes.tolist():
        lines.append(f"{size} " + " ".join(corners[at : at + size]))
        at += size
    return joined(lines)


def rewrite_off(data: bytes, points: np.ndarray, polygons: Polygons) -> bytes:
    """Return a file with other positions, and normals computed anew; all else stays."""
    lines = _records(data, keepends=True)
    filled = _filled(lines)
    first = _FIRST_WORD.fullmatch(content(lines[filled[0]])[0])
    rows = points
    if first and first[3]:
        rows = np.concatenate([points, np.round(vertex_normals(points, polygons), 6)], axis=1)
    begin = _body(lines, filled)
    for k, row in zip(filled[begin : begin + len(points)], rows.tolist(), strict=True):
        lines[k] = with_words(lines[k], 0, text_of(row))
    return b"".join(lines)


def color_words(data: bytes) -> list[list[bytes]]:
    """Return the words of each vertex that say its colour and opacity, if there are colours."""
    lines = _records(data)
    filled = _filled(lines)
    words = content(lines[filled[0]])
    kind = _FIRST_WORD.fullmatch(words[0])
    if not kind or not kind[2]:
        return []
    count = whole(_head(lines, filled)[0])
    begin = _body(lines, filled)
    at = 6 if kind[3] else 3
    return [content(lines[k])[at : at + 4] for k in filled[begin : begin + count]]


def has_face_colors(data: bytes) -> bool:
    """Return whether a face says more than its corners."""
    lines = _records(data)
    filled = _filled(lines)
    begin, n, m = _body(lines, filled), *map(whole, _head(lines, filled)[:2])
    faces = (content(lines[k]) for k in filled[begin + n : begin + n + m])
    return any(len(face) > 1 + whole(face[0]) for face in faces)


def _records(data: bytes, keepends: bool = False) -> list[bytes]:
    """Return the lines. Where records are not one a line, they are put so."""
    lines = data.splitlines(keepends)
    filled = _filled(lines)
    try:
        head = _head(lines, filled)
        n, m = whole(head[0]), whole(head[1])
        body = filled[_body(lines, filled) :]
        if _fill_lines(lines, body, n, m):
            return lines
        return _one_a_line([word for k in filled for word in content(lines[k])]) or lines
    except (ValueError, IndexError):
        return lines


def _fill_lines(lines: list[bytes], body: list[int], n: int, m: int) -> bool:
    """Return whether there is a line for each record, with as many words as it needs."""
    if len(body) < n + m:
        return False
    if any(len(content(lines[k])) < 3 for k in body[:n]):
        return False
    faces = (content(lines[k]) for k in body[n : n + m])
    return all(len(words) > whole(words[0]) for words in faces)


def _one_a_line(words: list[bytes]) -> list[bytes] | None:
    """Return the records, a line each, or None: the words are not just those records.

    Colours end with their line, so that a file with colours has one.
    """
    kind = _FIRST_WORD.fullmatch(words[0])
    if not kind or kind[1] or kind[2]:
        return None
    list(map(real, words[1:]))
    n, m = whole(words[1]), whole(words[2])
    width = 6 if kind[3] else 3
    at = 4 + width * n
    if min(n, m) < 0 or at > len(words):
        return None
    lines = [b" ".join(words[k : k + width]) for k in range(4, at, width)]
    for _ in range(m):
        end = at + 1 + max(whole(words[at]), 0)
        lines.append(b" ".join(words[at:end]))
        at = end
    return [line + b"\n" for line in (b" ".join(words[:4]), *lines)] if at == len(words) else None


def _filled(lines: list[bytes]) -> list[int]:
    """Return the lines that hold more than a comment."""
    return [
        k
        for k, line in enumerate(lines)
        if (line if b"#" not in line else line.split(b"#", 1)[0]).strip()
    ]


def _head(lines: list[bytes], filled: list[int]) -> list[bytes]:
    """Return the words of the counts: behind the first word, or on the next line."""
    behind = content(lines[filled[0]])[1:]
    return behind or (content(lines[filled[1]]) if len(filled) > 1 else [])


def _body(lines: list[bytes], filled: list[int]) -> int:
    """Return how many lines come before the first vertex: the counts may have one of their own."""
    return 1 if content(lines[filled[0]])[1:] else 2
