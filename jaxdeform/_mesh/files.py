"""Read and write mesh files. A file on disk is replaced as a whole or not at all."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_rigidity, check_type, read_path
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.formats import FORMATS, ply_columns, to_ply
from jaxdeform._mesh.mesh import Mesh, merge_equal_points


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Read a mesh from an OBJ, OFF, PLY or STL file.

    STL stores no shared vertices, so corners that are exactly equal are merged. Polygons with more
    than three corners are refused: how to cut them is the modeller's choice. A file that holds less
    than it announces is refused. An OBJ announces nothing unless :func:`save_mesh` or MeshLab
    wrote it.

    **Arguments**: path, whose suffix names the format.

    **Returns** the :class:`Mesh`, in the unit of the file.

    **Raises** InputError: the file is missing, empty, truncated, unreadable or of another kind, or
    its content is not a valid :class:`Mesh`.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.off"
        >>> jd.save_mesh(path, jd.shapes.bar())
        >>> jd.load_mesh(path)
        Mesh(722 vertices, 1440 faces)
    """
    vertices, faces = read_arrays(read_path("path", path))
    try:
        return Mesh(vertices, faces)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def save_mesh(
    path: str | os.PathLike,
    mesh: Mesh,
    *,
    vertices: ArrayLike | None = None,
    rigidity: ArrayLike | None = None,
) -> None:
    """Write a mesh as OBJ, OFF, PLY or STL; the suffix of the path chooses.

    The file is written under a temporary name and then renamed, so an old file is either kept or
    replaced as a whole. OBJ, OFF and PLY (binary) keep every bit; STL keeps single precision.

    **Arguments**

    - path: the file to write.
    - mesh: the mesh.
    - vertices: (vertices, 3), the positions of a pose; by default the rest positions.
    - rigidity: a number or (vertices,), written as the vertex property ``rigidity`` (PLY only).

    **Raises** InputError: the suffix is unknown; the folder cannot be written; a shape is wrong; a
    position is not finite.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=0.5)
        >>> jd.load_rigidity(path)[:2]
        array([0.5, 0.5])
    """
    path = read_path("path", path)
    suffix = _suffix(path)
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
    if rigidity is not None:
        if suffix != ".ply":
            raise InputError(f"{path}: only PLY carries rigidity per vertex: use a .ply name")
        rigidity = read_host_array(rigidity, np.float64, "rigidity")
        rigidity = np.asarray(check_rigidity(rigidity, mesh.n_vertices, rigidity.dtype))
        content = to_ply(points, mesh.faces, rigidity)
    else:
        content = FORMATS[suffix].to_bytes(points, mesh.faces)
    write_atomically(path, lambda name: Path(name).write_bytes(content))


def load_rigidity(path: str | os.PathLike) -> Float[np.ndarray, "vertices"]:
    """Read the rigidity per vertex from a PLY file that :func:`save_mesh` wrote.

    **Arguments**: path of a ``.ply`` file.

    **Returns** (vertices,) floats.

    **Raises** InputError: the file is not a PLY file, cannot be read, or lacks the vertex property
    ``rigidity``.

    Example:
        >>> import jaxdeform as jd, tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "bar.ply"
        >>> jd.save_mesh(path, jd.shapes.bar(), rigidity=2.0)
        >>> jd.load_rigidity(path).shape
        (722,)
    """
    path = read_path("path", path)
    if _suffix(path) != ".ply":
        raise InputError(f"{path}: rigidity is kept in .ply files only")
    columns, _ = ply_columns(path, _read_bytes(path))
    if "rigidity" not in columns:
        raise InputError(
            f"{path}: its vertices have no property 'rigidity' (only {', '.join(columns)}): write "
            "the file with jd.save_mesh(..., rigidity=...)"
        )
    return columns["rigidity"]


def read_arrays(
    path: str | os.PathLike,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read vertices and faces as the file gives them, valid or not.

    libigl is not used, because it crashes the process on a truncated OBJ, never returns from an
    empty OFF, and silently drops incomplete lines. 50,000 vertices take 0.2 s.

    **Raises** InputError: the file is missing, empty, truncated or unreadable, its suffix is
    unknown, or it holds polygons.
    """
    path = Path(path)
    suffix = _suffix(path)
    vertices, faces = FORMATS[suffix].parse(path, _read_bytes(path))
    if not len(faces):
        raise InputError(f"{path}: holds no triangles: export it as a triangle mesh")
    if suffix == ".stl":
        vertices, merged = merge_equal_points(vertices)
        faces = merged[faces]
    return vertices, faces


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{path}: unknown suffix '{path.suffix}': use one of {', '.join(FORMATS)}")
    return suffix


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): check the name") from error
    if not data.strip():
        raise InputError(f"{path}: is empty: export the mesh again")
    return data.removeprefix(b"\xef\xbb\xbf")


def write_atomically(path: Path, write: Callable[[str], object]) -> None:
    """Call ``write(name)`` on a temporary file in the same folder, then rename it to ``path``.

    **Raises** InputError if the folder cannot be written. An old file is then kept.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(suffix=path.suffix, prefix=".writing-", dir=path.parent)
    except OSError as error:
        raise InputError(
            f"{path}: cannot write there ({error.strerror}): check the folder"
        ) from error
    os.close(handle)
    try:
        write(name)
        mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
        os.chmod(name, mode)
        os.replace(name, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot write there ({error.strerror}): choose another name"
        ) from error
    finally:
        Path(name).unlink(missing_ok=True)


def check_output(path: str | os.PathLike) -> None:
    """Raise InputError if the suffix is unknown or the folder cannot be written.

    Example:
        >>> from jaxdeform._mesh.files import check_output
        >>> check_output("bent.ply")
    """
    path = Path(path)
    _suffix(path)
    check_place(path)


def check_place(path: Path) -> None:
    """Raise InputError if no file can be written at this path."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder: give the name of a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot write there: make the folder {path.parent} first")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: the folder {path.parent} cannot be written: choose another")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
