"""Report what is wrong with a mesh, and repair it."""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxdeform._checks import read_path
from jaxdeform._errors import ArrayLike, InputError, a_or_an, number_of
from jaxdeform._mesh.files import read_arrays
from jaxdeform._mesh.mesh import (
    NO_AREA,
    Mesh,
    checked_arrays,
    connected_components,
    degenerate_faces,
    merge_equal_points,
    unique_edges,
)
from jaxdeform._mesh.parsed import Source

# A broken mesh cannot become a Mesh, so the functions below take it in any of three forms.
MeshLike = Mesh | tuple[ArrayLike, ArrayLike] | str | os.PathLike[str]


def _arrays(mesh: Any) -> tuple[ArrayLike, ArrayLike, Source | None]:
    if isinstance(mesh, Mesh):
        return mesh.vertices, mesh.faces, mesh.source
    if isinstance(mesh, str | os.PathLike):
        return read_arrays(read_path("mesh", mesh))
    if not isinstance(mesh, list | tuple) or len(mesh) != 2:
        raise InputError(
            f"mesh is {a_or_an(mesh)}: give a Mesh, a pair (vertices, faces), or the path of a file"
        )
    return mesh[0], mesh[1], None


def repair(mesh: MeshLike) -> tuple[Mesh, Int[np.ndarray, "old"]]:
    """Merge equal vertices; drop degenerate faces, repeated faces and unreferenced vertices.

    **Arguments**: mesh, a `Mesh`, a pair (vertices, faces), or the path of a file.

    **Returns** the new mesh and, for each old vertex, its new index, or -1 if it was dropped.

    **Raises** InputError: an index is out of range or a vertex is not finite (no repair makes sense
    then); no face is left; the file cannot be read.

    Example:
        >>> import jaxdeform as jd
        >>> vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [5, 5, 5]]
        >>> mesh, new = jd.repair((vertices, [[0, 1, 2], [0, 1, 3], [2, 3, 0]]))
        >>> mesh, new.tolist()
        (Mesh(3 vertices, 1 faces), [0, 1, 2, 2, -1])
    """
    points, faces = checked_arrays(*_arrays(mesh)[:2])
    points, merged = merge_equal_points(points)
    faces = merged[faces]
    faces = np.delete(faces, [face for _, face in degenerate_faces(points, faces)], axis=0)
    _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(keep)]
    if not len(faces):
        raise InputError("no face with an area is left after the repair: export the mesh again")
    used = np.unique(faces)
    new = np.full(len(points), -1)
    new[used] = np.arange(len(used))
    return Mesh(points[used], new[faces]), new[merged]


@dataclass(frozen=True)
class Inspection:
    """What `inspect` found; ``str()`` turns it into a report.

    **Fields**

    - counts: sizes and measures by name: lengths in the unit of the mesh, angles in degrees.
    - findings: what is wrong or unusual, one sentence each, and what jaxdeform does about it.
    """

    counts: dict[str, int | float]
    findings: tuple[str, ...]

    def __str__(self) -> str:
        """Return the report."""
        width = max(len(name) for name in self.counts) if self.counts else 0
        shown = {k: str(v) if isinstance(v, int) else f"{v:g}" for k, v in self.counts.items()}
        lines = [f"{name:<{width}}  {value}" for name, value in shown.items()]
        lines += [f"- {finding}" for finding in self.findings] or ["- nothing unusual"]
        return "\n".join(lines)


def inspect(mesh: MeshLike) -> Inspection:
    """Report what is wrong or unusual with a mesh, even if it is broken.

    **Arguments**: mesh, a `Mesh`, a pair (vertices, faces), or the path of a file.

    **Returns** an `Inspection`.

    **Raises** InputError only if the argument is none of these or the file cannot be read.

    Example:
        >>> import jaxdeform as jd
        >>> jd.inspect(jd.shapes.bar()).findings
        ()
    """
    vertices, faces, source = _arrays(mesh)
    findings: list[str] = []

    def report(count: int, subject: str, rest: str, move: str) -> None:
        """Note a finding; the subject is that of one and that of many, with a bar between."""
        if count:
            findings.append(f"{number_of(count, *subject.split('|'))}{rest}: {move}")

    if source:
        polygons = int((source.polygons.sizes > 3).sum())
        report(
            polygons,
            "face has|faces have",
            " more than three corners",
            "cut into triangles for the work, kept whole in a file of the same mesh",
        )
        trailing = "byte follows|bytes follow"
        report(source.trailing, trailing, " the end of the mesh", "not read")
    try:
        points, faces = checked_arrays(vertices, faces)
    except InputError as error:
        return Inspection({}, (f"Unusable: {error}", *findings))
    n, m = len(points), len(faces)
    bad = degenerate_faces(points, faces)
    repeating = [k for reason, k in bad if reason != NO_AREA]
    flat = [k for reason, k in bad if reason == NO_AREA]
    remedy = "jd.repair drops such faces"
    repeat = f" a vertex (face {(repeating or [0])[0]})"
    report(len(repeating), "face repeats|faces repeat", repeat, remedy)
    report(
        len(flat),
        "face has|faces have",
        f" no area (face {(flat or [0])[0]})",
        f"edges weigh nothing there; {remedy}",
    )
    sound = np.delete(faces, [k for _, k in bad], axis=0)
    sound = sound[np.unique(np.sort(sound, axis=1), axis=0, return_index=True)[1]]
    unreferenced = n - len(np.unique(np.delete(faces, flat, axis=0)))
    report(
        unreferenced, "vertex belongs|vertices belong", " to no face with an area", "left in place"
    )
    duplicates = n - len(np.unique(points, axis=0))
    report(
        duplicates,
        "vertex lies|vertices lie",
        " exactly on another",
        "the mesh is not joined there; jd.repair merges",
    )
    repeated = m - len(np.unique(np.sort(faces, axis=1), axis=0))
    double = "edges weigh double there; jd.repair drops repeats"
    report(repeated, "face is|faces are", " repeated", double)
    counts: dict[str, int | float] = {"vertices": n, "faces": m}
    if len(sound):
        with np.errstate(all="ignore"):  # numbers near the ends of the range of float64
            _inspect_structure(points, sound, counts, report)
            _inspect_angles(points, sound, counts, report)
    return Inspection(counts, tuple(findings))


def _inspect_structure(points, faces, counts, report) -> None:
    edges = unique_edges(faces)
    counts["edges"] = len(edges)
    n = len(points)
    label = connected_components(edges, n)
    used = np.unique(faces)
    components = len(np.unique(label[used]))
    counts["components"] = components
    further = "further connected component|further connected components"
    report(components - 1, further, "", "each needs a handle of its own")

    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs, inverse, times = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    border, crowded = int((times == 1).sum()), int((times > 2).sum())
    counts["border edges"] = border
    counts["Euler characteristic"] = len(used) - len(pairs) + len(faces)
    open_there = "the surface is open there, which is allowed"
    report(border, "edge lies|edges lie", " on the border", open_there)
    many_faces = " more than two faces"
    report(crowded, "edge has|edges have", many_faces, "non-manifold, which is allowed")
    report(
        int((_fans(faces, inverse.ravel()) > 1).sum()),
        "vertex joins|vertices join",
        " surfaces that meet nowhere else",
        "non-manifold, which is allowed",
    )
    ascending = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    twist = np.bincount(inverse.ravel(), ascending)
    clash = int(((times == 2) & (twist != 0)).sum())
    report(
        clash,
        "edge has|edges have",
        " faces of opposite orientation",
        "harmless: around each vertex one side is chosen",
    )
    center = points[used].mean(axis=0)
    a, b, c = (points[faces[:, k]] - center for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    component = label[faces[:, 0]]
    is_open = np.unique(label[pairs[times != 2][:, 0]])
    inward = [
        k for k in np.unique(component) if k not in is_open and volume[component == k].sum() < 0
    ]
    report(
        len(inward),
        "closed component faces|closed components face",
        " inwards",
        "harmless: normals rotate with the surface",
    )


def _fans(faces: np.ndarray, edge: np.ndarray) -> Int[np.ndarray, "vertices"]:
    """Return how many fans meet at each vertex. A fan is a set of faces joined by edges at it.

    ``edge`` numbers the undirected edges of each face, in the order 0-1, 1-2, 2-0 of its corners.
    """
    # Two corners at a vertex belong to the same fan if their faces share an edge that ends there.
    corner = np.arange(faces.size).reshape(-1, 3)
    node = corner[:, [0, 1, 1, 2, 2, 0]].ravel()
    key = np.repeat(edge, 2) * (faces.max() + 1) + faces.ravel()[node]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    links = (node[order][:-1][same], node[order][1:][same])
    label = connected_components(np.stack(links, axis=1), faces.size)
    _, first = np.unique(label, return_index=True)
    return np.bincount(faces.ravel()[first])


def _inspect_angles(points, faces, counts, report) -> None:
    corner = points[faces]
    edge = np.roll(corner, -1, axis=1) - corner
    length = np.linalg.norm(edge, axis=2)
    unit = edge / length[:, :, None]
    cosine = -np.einsum("ijk,ijk->ij", unit, np.roll(unit, 1, axis=1))
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    counts["shortest edge"] = float(length.min())
    counts["longest edge"] = float(length.max())
    counts["bounding box diagonal"] = float(
        np.linalg.norm(np.ptp(points[np.unique(faces)], axis=0))
    )
    counts["smallest angle"] = float(angle.min())
    counts["largest angle"] = float(angle.max())
    radians = np.radians(angle)
    cot = np.cos(radians) / np.maximum(np.sin(radians), 1e-300)
    # The angle at corner k is opposite the edge from corner k + 1 to corner k + 2.
    opposite = np.sort(np.stack([np.roll(faces, -1, 1), np.roll(faces, -2, 1)], axis=2), axis=2)
    _, inverse = np.unique(opposite.reshape(-1, 2), axis=0, return_inverse=True)
    weight = np.bincount(inverse.ravel(), cot.ravel()) / 2
    report(
        int((weight < -1e-9).sum()),
        "edge has a negative cotangent weight|edges have negative cotangent weights",
        " (obtuse angles)",
        "kept, but set to 0 in cells whose moments they make indefinite (see jd.rings)",
    )
    below = " below 1 degree"
    report(
        int((angle < 1.0).sum()), "angle is|angles are", below, "expect slower convergence there"
    )
