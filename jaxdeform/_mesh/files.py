"""Read and write mesh files."""

import gzip
import os
import warnings
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_type, read_path
from jaxdeform._errors import ArrayLike, InputError, printable
from jaxdeform._mesh.extras import file_extras, of_own_format
from jaxdeform._mesh.formats import FORMATS
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.parsed import Extras, Source
from jaxdeform._mesh.ply import rewrite_ply, vertex_columns
from jaxdeform._mesh.ply_writing import to_ply
from jaxdeform._mesh.polygons import from_triangles, triangles
from jaxdeform._mesh.reading import mark_of, read_bytes, without_mark
from jaxdeform._mesh.stl import check_stl, is_binary
from jaxdeform._mesh.writing import check_place, write_atomically
from jaxdeform._values import read_rigidity

# Cutting ears takes time by the square of the corners: 5,000 take half a second.
_MOST_CORNERS = 5_000


def load_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh from an OBJ, OFF, PLY or STL file.

    Polygons with more than three corners are cut into triangles for the work: a quad along its
    shorter diagonal, any other with short diagonals that stay inside; one that is not planar, as
    its shadow in its mean plane. The mesh remembers its file (``source``), so that
    `save_mesh` writes the polygons, and all else that the file held, as they were.

    STL stores no shared vertices, so corners that are exactly equal are merged. A file that holds
    less than it announces is refused; bytes behind its end are not (`inspect` tells of
    them). An OBJ announces nothing unless `save_mesh` or MeshLab wrote it. Memory and time
    are in proportion to the size of the file.

    **Arguments**: path, whose suffix names the format. Behind it may stand ``.gz``.

    **Returns** the `Mesh`, in the unit of the file.

    **Raises** InputError: the file is missing, empty, truncated, unreadable or of another kind (a
    pipe or a device, a point cloud), or its content is not a valid `Mesh`.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.off"
        >>> jd.save_mesh(path, jd.shapes.bar())
        >>> jd.load_mesh(path)
        Mesh(722 vertices, 1440 faces)
    """
    path = read_path("path", path)
    vertices, faces, source = read_arrays(path)
    try:
        return Mesh(vertices, faces, source=source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def save_mesh(
    path: str | os.PathLike[str],
    mesh: Mesh,
    *,
    vertices: ArrayLike | None = None,
    rigidity: ArrayLike | None = None,
) -> None:
    """Write a mesh as OBJ, OFF, PLY or STL; the suffix of the path chooses.

    With ``.gz`` behind the suffix the file is compressed.

    A mesh that `load_mesh` read is written in the format of its file as that file with other
    positions: polygons, texture coordinates, colours, groups, materials, values per face and
    comments stay, and normals are computed anew. Without a change it is the same file, byte for
    byte. In another format the polygons stay, and colours (as bytes in PLY and OFF) and texture
    coordinates (not in OFF) where it can hold them; a warning says what is lost. For a plain file,
    write ``jd.Mesh(mesh.vertices, mesh.faces)``. Files that the mesh names, such as an OBJ's
    ``mtllib``, are not copied.

    OBJ, OFF, text STL and PLY keep every bit: a PLY's ``float`` positions become ``double`` if they
    need more digits than ``float`` holds. Binary STL keeps single precision, with a warning if an
    edge feels it. Any STL makes one vertex of those in one place, and leaves out those without a
    face, with a warning if there are such.

    The file is written under a temporary name, brought to the disk and then renamed, so an old file
    is either kept or replaced as a whole. It keeps its permissions, and a symbolic link stays one.

    **Arguments**

    - path: the file to write.
    - mesh: the mesh.
    - vertices: (vertices, 3), the positions of a pose; by default the rest positions.
    - rigidity: a number or (vertices,), written as the vertex property ``rigidity`` (PLY only).

    **Raises** InputError: the suffix is unknown; the folder cannot be written; the file is
    read-only; a shape is wrong; a position is not finite; a rigidity is not finite or negative;
    `load_mesh` would refuse the file: no face of the pose has an area, its lengths are out of
    range, or in an STL a face would have two corners in one place.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=0.5)
        >>> jd.load_rigidity(path)[:2]
        array([0.5, 0.5])
    """
    path = read_path("path", path)
    suffix = format_of(path)
    check_type("mesh", mesh, Mesh)
    points = mesh.vertices if vertices is None else vertices
    points = read_host_array(points, np.float64, "vertices")
    if points.shape != mesh.vertices.shape:
        raise InputError(
            f"vertices have shape {points.shape}, but the mesh has {mesh.vertices.shape}: a pose "
            "needs one position per vertex"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"{path}: vertex {bad[0]} is {points[bad[0]].tolist()} ({bad.size} in total): not "
            "written, because no program could read it; give finite positions"
        )
    if vertices is not None:
        _check_pose(path, points, mesh)
    if rigidity is not None:
        if suffix != ".ply":
            raise InputError(f"{path}: only PLY carries rigidity per vertex: use a .ply name")
        rigidity = read_host_array(rigidity, np.float64, "rigidity")
        rigidity = np.asarray(read_rigidity(rigidity, mesh.n_vertices, rigidity.dtype))
    content = _content(path, suffix, mesh, points, rigidity)
    if path.suffix.lower() == ".gz":
        content = gzip.compress(content, mtime=0)
    write_atomically(path, content)


def _check_pose(path: Path, points: np.ndarray, mesh: Mesh) -> None:
    """Raise InputError unless the positions make a mesh that `load_mesh` would take."""
    try:
        Mesh(points, mesh.faces)
    except InputError as error:
        raise InputError(
            f"{path}: not written, because load_mesh would refuse it ({error}): give another pose"
        ) from error


def _content(
    path: Path, suffix: str, mesh: Mesh, points: np.ndarray, rigidity: np.ndarray | None
) -> bytes:
    source = mesh.source if mesh.source and mesh.source.suffix == suffix else None
    if source and rigidity is None and np.array_equal(points, source.points):
        return source.data
    if suffix == ".stl":
        for loss in check_stl(path, points, mesh.faces, binary=not _is_text_stl(mesh)):
            warnings.warn(loss, stacklevel=3)
    to_bytes, rewrite = FORMATS[suffix].to_bytes, FORMATS[suffix].rewrite
    if rigidity is not None:
        to_bytes, rewrite = (
            partial(to_ply, rigidity=rigidity),
            partial(rewrite_ply, rigidity=rigidity),
        )
    if source is None:
        kept = mesh.source.polygons if mesh.source else None
        if kept is None or suffix == ".stl":
            kept = from_triangles(mesh.faces)
        return to_bytes(points, kept, _extras(path, suffix, mesh.source))
    data = without_mark(source.data)
    return mark_of(source.data) + rewrite(data, points, source.polygons)


def _extras(path: Path, suffix: str, source: Source | None) -> Extras:
    """Return what the new format holds of what the file had, with a warning for what is lost."""
    found = file_extras(source)
    names = {"colors": "colours", "texture": "texture coordinates"}
    holds = FORMATS[suffix].holds
    had = [name for name in names if getattr(found, name) is not None]
    lost = [names[name] for name in had if name not in holds] + of_own_format(source, found)
    if lost:
        shown = [printable(name) for name in lost[:8]] + ["..."] * (len(lost) > 8)
        text = " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)
        warnings.warn(
            f"{path}: {suffix[1:].upper()} cannot hold the {text} of the file that the mesh was "
            "read from: they are not written",
            stacklevel=4,
        )
    return found


def load_rigidity(path: str | os.PathLike[str]) -> Float[np.ndarray, "vertices"]:
    """Read the rigidity per vertex from a PLY file that `save_mesh` wrote.

    **Arguments**: path of a ``.ply`` file.

    **Returns** (vertices,) floats.

    **Raises** InputError: the file is not a PLY file, cannot be read, or lacks the vertex property
    ``rigidity``; a value is not finite or negative.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=2.0)
        >>> jd.load_rigidity(path).shape
        (722,)
    """
    path = read_path("path", path)
    if format_of(path) != ".ply":
        raise InputError(f"{path}: rigidity is kept in .ply files only")
    columns = vertex_columns(path, without_mark(read_bytes(path)))
    if "rigidity" not in columns:
        raise InputError(
            f"{path}: its vertices have no property 'rigidity' (only {', '.join(columns)}): write "
            "the file with jd.save_mesh(..., rigidity=...)"
        )
    values = columns["rigidity"]
    try:
        read_rigidity(values, len(values), values.dtype)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return values


class FileArrays(NamedTuple):
    """What a file says of a mesh, valid or not."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    source: Source


def read_arrays(path: Path) -> FileArrays:
    """Read vertices and faces as the file gives them, valid or not; polygons are cut.

    libigl is not used, because it crashes the process on a truncated OBJ, never returns from an
    empty OFF, and silently drops incomplete lines. 50,000 vertices take 0.2 s.

    **Raises** InputError: the file is missing, empty, truncated or unreadable, its suffix is
    unknown, or it holds no faces.
    """
    suffix = format_of(path)
    data = read_bytes(path)
    with np.errstate(invalid="ignore"):  # what is not finite is refused later
        points, polygons, trailing = FORMATS[suffix].parse(path, without_mark(data))
    if not len(polygons.sizes):
        raise InputError(
            f"{path}: holds {len(points)} points and no faces: make a surface of them first"
        )
    largest = int(polygons.sizes.max())
    if largest > _MOST_CORNERS:
        raise InputError(
            f"{path}: face {polygons.sizes.argmax()} has {largest} corners: cut it into triangles "
            "in a modeller; here that would take too long"
        )
    source = Source(suffix, data, polygons, trailing, points, path.absolute())
    return FileArrays(points, triangles(points, polygons), source)


def format_of(path: Path) -> str:
    """Return the suffix of the format, without the ``.gz`` behind it."""
    suffix = Path(path.stem).suffix if path.suffix.lower() == ".gz" else path.suffix
    if suffix.lower() not in FORMATS:
        raise InputError(f"{path}: unknown suffix '{suffix}': use one of {', '.join(FORMATS)}")
    return suffix.lower()


def check_output(path: str | os.PathLike[str], mesh: Mesh | None = None) -> None:
    """Raise InputError if a file, or this mesh at rest, cannot be written under this name.

    Example:
        >>> from jaxdeform._mesh.files import check_output
        >>> check_output("bent.ply")
    """
    path = Path(path)
    suffix = format_of(path)
    check_place(path)
    if mesh and suffix == ".stl":
        check_stl(path, mesh.vertices, mesh.faces, binary=not _is_text_stl(mesh))


def without_suffix(path: Path) -> Path:
    """Return the path without the suffix of the format, and without ``.gz``."""
    return (path.with_suffix("") if path.suffix.lower() == ".gz" else path).with_suffix("")


def _is_text_stl(mesh: Mesh) -> bool:
    """Return whether the mesh was read from a text STL, and so is written as one."""
    source = mesh.source
    return source is not None and source.suffix == ".stl" and not is_binary(source.data)
