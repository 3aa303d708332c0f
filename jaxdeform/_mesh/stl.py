"""STL files, binary and text: read, write, and rewrite with other positions."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._errors import InputError
from jaxdeform._mesh.mesh import merge_equal_points
from jaxdeform._mesh.parsed import Extras, Parsed
from jaxdeform._mesh.polygons import (
    Polygons,
    area_vectors,
    from_lists,
    from_triangles,
    unit,
)
from jaxdeform._mesh.words import (
    PADDING,
    content,
    damaged,
    excerpt,
    position,
    stacked,
    text_of,
    with_words,
)

_FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_HEAD = 84

# Lines that stay as they are.
_KEPT = frozenset(b"solid outer endloop endsolid color".split())
_KNOWN = _KEPT | {b"facet", b"vertex", b"endfacet"}


def parse_stl(path: Path, data: bytes) -> Parsed:
    """Read polygons. Corners that are exactly equal are one vertex, as STL shares none."""
    count = _count(data)
    behind = len(data) - _HEAD - _FACET.itemsize * count
    if count > 0 and behind >= 0:
        if behind and behind % _FACET.itemsize == 0:
            found = count + behind // _FACET.itemsize
            raise damaged(path, f"announces {count} faces but has room for {found}")
        corners = np.frombuffer(data, _FACET, count, _HEAD)["corners"].reshape(-1, 3)
        polygons = from_triangles(np.arange(3 * count).reshape(-1, 3))
    elif data.lstrip()[:5].lower() == b"solid":
        corners, polygons, behind = _parse_text(path, data)
    else:
        raise damaged(path, "is neither ASCII STL nor as long as its face count says")
    if not len(corners):
        return Parsed(stacked([]), polygons)
    points, merged = merge_equal_points(corners.astype(np.float64))
    return Parsed(points, Polygons(polygons.sizes, merged[polygons.corners]), behind)


def _count(data: bytes) -> int:
    return int.from_bytes(data[80:_HEAD], "little") if len(data) >= _HEAD else 0


def is_binary(data: bytes) -> bool:
    """Return whether the content is that of a binary file that `parse_stl` accepts."""
    return 0 < _count(data) * _FACET.itemsize <= len(data) - _HEAD


def _parse_text(path: Path, data: bytes) -> tuple[Float[np.ndarray, "corners 3"], Polygons, int]:
    corners: list[tuple[float, ...]] = []
    sizes: list[int] = []
    facets, used, last = 0, 0, b""
    behind, unknown = 0, None
    data = data.rstrip(PADDING)
    for number, line in enumerate(data.splitlines(), 1):
        words = content(line)
        if not words:
            continue
        keyword = words[0].lower()
        if last == b"endsolid" and keyword not in _KNOWN:
            # Behind the end may stand anything, but no further faces.
            behind += len(line)
            unknown = unknown or _unknown(path, number, words)
            continue
        if unknown:
            raise unknown
        last = keyword
        if last == b"vertex":
            corners.append(position(path, number, words[1:]))
        elif last == b"facet":
            facets += 1
        elif last == b"endfacet":
            sizes.append(len(corners) - used)
            used = len(corners)
            if sizes[-1] < 3:
                raise damaged(path, f"face {len(sizes) - 1} is a face with {sizes[-1]} corners")
        elif last not in _KEPT:
            raise _unknown(path, number, words)
    if last != b"endsolid":
        raise damaged(path, "does not end with endsolid")
    if used != len(corners) or facets != len(sizes):
        raise damaged(path, "has a face that does not end with endfacet")
    return stacked(corners), from_lists(sizes, list(range(used))), behind


def _unknown(path: Path, number: int, words: list[bytes]) -> InputError:
    return InputError(
        f"{path}: line {number} {excerpt(words)} begins with an unknown keyword: correct it, or "
        "put # before it"
    )


def to_stl(points: np.ndarray, polygons: Polygons, extras: Extras) -> bytes:
    """Return the content of a binary file, in single precision; the polygons are triangles."""
    del extras  # it holds none
    facets = np.zeros(len(polygons.sizes), _FACET)
    head = b"STL".ljust(80) + len(facets).to_bytes(4, "little")
    return head + _filled(facets, points, polygons)


def rewrite_stl(data: bytes, points: np.ndarray, polygons: Polygons) -> bytes:
    """Return a file with other positions and normals. Its head, names and attributes stay."""
    if is_binary(data):
        end = _HEAD + _FACET.itemsize * _count(data)
        facets = np.frombuffer(data[:end], _FACET, offset=_HEAD).copy()
        return data[:_HEAD] + _filled(facets, points, polygons) + data[end:]
    corners = iter(points[polygons.corners].tolist())
    normals = iter(np.round(unit(area_vectors(points, polygons)), 6).tolist())
    out = []
    for line in data.splitlines(keepends=True):
        words = [word.lower() for word in content(line)[:2]]
        if words[:1] == [b"vertex"]:
            line = with_words(line, 1, text_of(next(corners)))
        elif words == [b"facet", b"normal"]:
            line = with_words(line, 2, text_of(next(normals)))
        out.append(line)
    return b"".join(out)


def _filled(facets: np.ndarray, points: np.ndarray, polygons: Polygons) -> bytes:
    facets["normal"] = unit(area_vectors(points, polygons))
    facets["corners"] = points[polygons.corners].reshape(-1, 3, 3)
    return facets.tobytes()


def check_stl(path: Path, points: np.ndarray, faces: np.ndarray, *, binary: bool) -> list[str]:
    """Return what a file would lose that matters.

    **Raises** InputError: two corners of a face lie or would lie in one place, or a number is out
    of range, so that `load_mesh` could not read the mesh again.
    """
    corner, move = points[faces], "write .obj, .off or .ply"
    equal = _repeats_a_place(corner)
    if equal.any():
        raise InputError(
            f"{path}: not written: {int(equal.sum())} faces have two corners in one place (face "
            f"{int(equal.argmax())}), and STL makes one vertex of those: {move}"
        )
    lost, kept = [], points
    if binary:
        with np.errstate(over="ignore"):
            kept = points.astype(np.float32).astype(np.float64)
        loss = float(np.abs(kept - points).max())
        moves = f"STL keeps single precision, in which positions move by up to {loss:.2g} and"
        near = f"{move}, or move the mesh near the origin"
        equal = _repeats_a_place(kept[faces])
        if equal.any() or not np.isfinite(loss):
            raise InputError(
                f"{path}: not written: {moves} {int(equal.sum())} faces collapse (face "
                f"{int(equal.argmax())}): {near}"
            )
        edge = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
        if loss > 1e-3 * edge.min():
            lost = [f"{path}: {moves} the shortest edge is {edge.min():.2g}: {near}"]
    used = np.unique(faces)
    joined = len(used) - len(merge_equal_points(kept[used])[0])
    if joined:
        lost.append(
            f"{path}: STL makes one vertex of those in one place, so that {joined} fewer come back "
            f"and surfaces that were apart may hang together: {move}"
        )
    if len(used) < len(points):
        lost.append(
            f"{path}: STL holds faces alone, so that {len(points) - len(used)} vertices without a "
            f"face do not come back, and those after them have other numbers: {move}"
        )
    return lost


def _repeats_a_place(corner: Float[np.ndarray, "faces 3 3"]) -> Bool[np.ndarray, "faces"]:
    return (corner == np.roll(corner, 1, axis=1)).all(axis=2).any(axis=1)
