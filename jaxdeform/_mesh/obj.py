"""OBJ files (Wavefront): read, write, and rewrite with other positions."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._errors import InputError
from jaxdeform._mesh.grouping import summed
from jaxdeform._mesh.normals import corner_sides, corner_vectors
from jaxdeform._mesh.parsed import Extras, Parsed
from jaxdeform._mesh.polygons import Polygons, from_lists, unit
from jaxdeform._mesh.words import (
    PADDING,
    content,
    damaged,
    excerpt,
    joined,
    position,
    real,
    stacked,
    text_of,
    whole,
    with_words,
)

# What the specification has besides v, vn and f. Such lines stay as they are.
_KEPT = frozenset(
    b"vt vp deg bmat step cstype p l curv curv2 surf parm trim hole scrv sp end con g s mg o bevel "
    b"c_interp d_interp lod maplib usemap usemtl mtllib shadow_obj trace_obj ctech stech call csh "
    b"bsp bzp cdc cdp res".split()
)

# MeshLab writes these counts too. Without them a truncated OBJ could not be recognised.
_COUNT = re.compile(rb"^# (Vertices|Faces): (\d{1,12})\s*$", re.MULTILINE)


def parse_obj(path: Path, data: bytes) -> Parsed:
    """Read positions and polygons; know every keyword, skip what is no surface."""
    text = data.rstrip(PADDING)
    trailing = len(data) - len(text)
    # Where a line was cut off, a disk may have put zeros.
    if trailing and not text.endswith((b"\n", b"\r")):
        raise damaged(path, "ends within a line")
    data = text
    points: list[tuple[float, ...]] = []
    sizes: list[int] = []
    corners: list[int] = []
    for number, line in _lines(path, data):
        words = content(line)
        keyword = _keyword(words)
        if keyword == b"v":
            points.append(position(path, number, words[1:4]))
        elif keyword == b"f":
            face = _face(path, number, words)
            # Negative indices count back from the last vertex so far.
            corners += [k - 1 if k > 0 else len(points) + k if k < 0 else -1 for k in face]
            sizes.append(len(face))
        elif keyword not in _KEPT and keyword not in (b"", b"vn"):
            raise InputError(
                f"{path}: line {number} {excerpt(words)} begins with an unknown keyword: correct "
                "it, or put # before it"
            )
    announced = {kind: int(count) for kind, count in _COUNT.findall(data)}
    for kind, found in ((b"Vertices", points), (b"Faces", sizes)):
        if len(found) < announced.get(kind, 0):
            raise damaged(
                path, f"announces {announced[kind]} {kind.decode().lower()} but holds fewer"
            )
    # Who writes counts ends lines. Without its end, a last face may have lost corners.
    if announced and not data.endswith((b"\n", b"\r")):
        raise damaged(path, "ends within a line")
    try:
        return Parsed(stacked(points), from_lists(sizes, corners), trailing)
    except OverflowError:
        raise damaged(path, "names a vertex out of range") from None


def _face(path: Path, number: int, words: list[bytes]) -> list[int]:
    if len(words) < 4:
        raise damaged(path, f"line {number} is a face with {len(words) - 1} corners")
    try:
        corners = [word.split(b"/", 1)[0] if b"/" in word else word for word in words[1:]]
        if b"_" in b"".join(corners) or b"\\" in b"".join(words):
            raise ValueError
        return list(map(int, corners))
    except ValueError:
        raise damaged(path, f"line {number} {excerpt(words)} is not a face") from None


def to_obj(points: np.ndarray, polygons: Polygons, extras: Extras) -> bytes:
    """Return the content of a file."""
    lines = [f"# Vertices: {len(points)}", f"# Faces: {len(polygons.sizes)}"]
    rows = points if extras.colors is None else np.concatenate([points, extras.colors], axis=1)
    lines += ["v " + " ".join(map(repr, row)) for row in rows.tolist()]
    corners = list(map(str, (polygons.corners + 1).tolist()))
    if extras.texture is not None:
        has = ~np.isnan(extras.texture).any(axis=1)
        pairs, index = np.unique(extras.texture[has], axis=0, return_inverse=True)
        lines += [f"vt {u!r} {v!r}" for u, v in pairs.tolist()]
        for k, named in zip(np.flatnonzero(has).tolist(), index.ravel().tolist(), strict=True):
            corners[k] += f"/{named + 1}"
    at = 0
    for size in polygons.sizes.tolist():
        lines.append("f " + " ".join(corners[at : at + size]))
        at += size
    return joined(lines)


def rewrite_obj(data: bytes, points: np.ndarray, polygons: Polygons) -> bytes:
    """Return a file with other positions, and normals computed anew; all other lines stay.

    One ``vn`` may serve many vertices, whose normals were equal and are no longer so. Then further
    ``vn`` lines follow the last one, and the ``f`` lines name them.
    """
    lines, keywords = _keyed_lines(data)
    rows = iter(points.tolist())
    out = [
        with_words(line, 1, text_of(next(rows))) if keyword == b"v" else line
        for keyword, line in zip(keywords, lines, strict=True)
    ]
    at = [k for k, keyword in enumerate(keywords) if keyword == b"vn"]
    faces = [k for k, keyword in enumerate(keywords) if keyword == b"f"]
    if not at or not faces:
        return b"".join(out)
    known: dict[bytes, int] = {}
    alike = [known.setdefault(b" ".join(_corner_words(lines[k])), len(known)) for k in at]
    named = _named(keywords, lines, b"vn", 2)
    normals, index = _new_normals(points, polygons, named, np.array(alike))
    text = [[b"%.6f" % x for x in row] for row in normals.tolist()]
    used = np.isin(np.arange(len(normals)), index)
    for k, line in enumerate(at):
        if used[k]:
            out[line] = with_words(out[line], 1, text[k])
    if len(normals) > len(at):
        more = text[len(at) :]
        tail = b"" if out[at[-1]].endswith((b"\n", b"\r")) else b"\n"
        out[at[-1]] += tail + b"".join(b"vn " + b" ".join(words) + b"\n" for words in more)
        starts = polygons.starts
        for k, start, size in zip(faces, starts.tolist(), polygons.sizes.tolist(), strict=True):
            out[k] = _with_normals(out[k], index[start : start + size].tolist())
    return b"".join(out)


def _keyword(words: list[bytes]) -> bytes:
    """Return the keyword of a line in small letters. A comment has none."""
    if not words:
        return b""
    keyword = words[0]
    if keyword in (b"v", b"f"):
        return keyword
    keyword = keyword.split(b"#", 1)[0].lower()
    return b"f" if keyword == b"fo" else keyword


def _lines(path: Path | None, data: bytes) -> Iterator[tuple[int, bytes]]:
    r"""Return each line with its number and its end. A line goes on after a ``\`` at its end.

    A comment does not go on: after ``# C:\`` the next line would be lost.
    """
    lines = data.splitlines(keepends=True)
    if b"\\" not in data:
        yield from enumerate(lines, 1)
        return
    open_: list[bytes] = []
    for number, line in enumerate(lines, 1):
        before_comment = line.split(b"#", 1)[0]
        goes_on = before_comment.rstrip().endswith(b"\\") and before_comment == line
        if goes_on:
            open_.append(line if path is None else line.rstrip()[:-1] + b" ")
            continue
        yield number, b"".join([*open_, line])
        open_ = []
    if open_ and path is not None:
        raise damaged(path, "ends in a line that goes on")
    if open_:
        yield len(lines), b"".join(open_)


def _keyed_lines(data: bytes) -> tuple[list[bytes], list[bytes]]:
    """Return the lines, those that go on as one, and the keyword of each."""
    lines = [line for _, line in _lines(None, data)]
    return lines, [_keyword(_plain(line).split(None, 1)[:1]) for line in lines]


def color_words(data: bytes) -> list[list[bytes]]:
    """Return the words behind the position of each vertex."""
    rows = (content(_plain(line)) for _, line in _lines(None, data))
    return [row[4:7] for row in rows if _keyword(row) == b"v"]


def all_keywords(data: bytes) -> list[bytes]:
    """Return the keyword of each line, in small letters."""
    return _keyed_lines(data)[1]


def material_of_faces(data: bytes) -> tuple[list[bytes], list[bytes]]:
    """Return the libraries of materials, and the material of each face, or an empty name."""
    libraries, used, now = [], [], b""
    for line, keyword in zip(*_keyed_lines(data), strict=True):
        name = line.split(None, 1)[1].strip() if len(line.split(None, 1)) > 1 else b""
        if keyword == b"mtllib":
            libraries.append(name)
        elif keyword == b"usemtl":
            now = name
        elif keyword == b"f":
            used.append(now)
    return libraries, used


def corner_texture(data: bytes, polygons: Polygons) -> Float[np.ndarray, "corners 2"] | None:
    """Return the texture coordinates of each corner; NaN where it names none."""
    lines, keywords = _keyed_lines(data)
    named = _named(keywords, lines, b"vt", 1)
    words = [
        content(_plain(line))[1:3]
        for keyword, line in zip(keywords, lines, strict=True)
        if keyword == b"vt"
    ]
    try:
        pairs = np.array([[real(word) for word in (*row, b"0")[:2]] for row in words])
    except ValueError:
        return None
    if not len(pairs) or pairs.shape[1:] != (2,) or len(named) != len(polygons.corners):
        return None
    there = (named >= 0) & (named < len(pairs))
    return np.where(there[:, None], pairs[np.where(there, named, 0)], np.nan)


def _named(
    keywords: list[bytes], lines: list[bytes], kind: bytes, place: int
) -> Int[np.ndarray, "corners"]:
    """Return the line of this kind that each corner of each face names in that place, or -1."""
    named: list[int] = []
    count = 0
    for keyword, line in zip(keywords, lines, strict=True):
        count += keyword == kind
        if keyword != b"f":
            continue
        for word in _corner_words(line):
            parts = word.split(b"/")
            try:
                k = whole(parts[place])
            except (IndexError, ValueError):
                k = 0
            named.append(k - 1 if k > 0 else max(count + k, -1) if k < 0 else -1)
    return np.array([k if k < (1 << 62) else -1 for k in named], np.int64)


def _corner_words(line: bytes) -> list[bytes]:
    return content(_plain(line))[1:]


def _plain(line: bytes) -> bytes:
    """Return the line without the signs that continue it."""
    return line.replace(b"\\", b" ")


def _new_normals(
    points: np.ndarray,
    polygons: Polygons,
    named: Int[np.ndarray, "corners"],
    alike: Int[np.ndarray, "old"],
) -> tuple[Float[np.ndarray, "normals 3"], Int[np.ndarray, "corners"]]:
    """Return the normals, of which the first are the old ones, and which each corner names.

    The normal of a vertex is that of the faces whose old normals there were alike (``alike`` has
    the same number for those), weighted by area. So a smooth surface stays smooth, and a sharp edge
    stays sharp.
    """
    count = len(alike)
    named = np.where(named < count, named, -1)
    has = np.flatnonzero(named >= 0)
    vertex = polygons.corners[has]
    vectors = corner_vectors(points, polygons)[has]
    key = alike[named[has]] * len(points) + vertex
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    sides = corner_sides(polygons)
    if sides is not None:
        side = sides[has]
        vectors *= (side * side[first[group]])[:, None]  # the first face's, in each group
    sums = summed(vectors, group, int(group.max(initial=-1)) + 1)
    code = named[has] * len(points) + vertex
    pairs, one, inverse = np.unique(code, return_index=True, return_inverse=True)
    normal = unit(sums[group[one]])
    old = pairs // len(points)
    _, first = np.unique(old, return_index=True)
    leader = np.repeat(first, np.diff(np.append(first, len(pairs))))
    # Equal but for rounding in the file.
    apart = np.linalg.norm(normal - normal[leader], axis=1) > 1e-6
    clash = np.isin(old, old[apart])
    extra = clash & (np.arange(len(pairs)) != leader)
    new = old.copy()
    new[extra] = count + np.arange(int(extra.sum()))
    normals = np.zeros((count + int(extra.sum()), 3))
    normals[new[::-1]] = normal[::-1]
    index = np.full(len(named), -1)
    index[has] = new[inverse]
    return normals, index


def _with_normals(line: bytes, index: list[int]) -> bytes:
    """Return a line of a face whose corners name these normals; -1 keeps what was there."""
    words = []
    for word, k in zip(_corner_words(line), index, strict=True):
        parts = word.split(b"/")
        words.append(word if k < 0 else b"/".join([*parts[:2], str(k + 1).encode()]))
    return with_words(line, 1, words)
