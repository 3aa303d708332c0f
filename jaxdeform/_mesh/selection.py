"""A set of vertices of a mesh, and the way in for every argument that chooses vertices."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from jaxdeform._arrays import read_integers, read_numbers, read_only
from jaxdeform._checks import check_index, check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._values import read_labels


@dataclass(frozen=True, eq=False, init=False)
class Selection:
    """A set of vertices of one mesh. The functions of ``jd.select`` make them.

    ``a | b`` has the vertices of either, ``a & b`` of both, ``a - b`` of a only, and ``~a`` all
    others. The other side may also be a mask (vertices,) or a list of vertex indices.

    A selection stands wherever a function takes vertex indices, and as an index of NumPy's arrays:
    ``mesh.vertices[selection]``. (JAX's take ``selection.vertices``.) Its vertices are in ascending
    order. It may be of a mesh with the same faces and other positions, such as the rest shape of a
    pose. It is a value: two selections of the same vertices of equal meshes are equal.

    **Arguments**: mesh; mask, booleans (vertices,).

    **Raises** InputError: a mask of another shape, or of values that are not booleans.

    **Fields**

    - mesh: the mesh whose vertices they are.
    - mask: (vertices,) True for each vertex of the selection. Read-only; for values per vertex,
      such as ``np.where(selection.mask, 30.0, 0.01)``.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> ends = jd.select.where(mesh, "y < 6") | jd.select.where(mesh, "y > 145")
        >>> ends
        Selection(146 of 722 vertices)
        >>> jd.precompute(mesh, ends).handles.shape
        (146,)
    """

    mesh: Mesh
    mask: Bool[np.ndarray, "vertices"]

    # Else NumPy would work on the indices in ``mask & selection``, instead of asking __rand__.
    __array_ufunc__ = None

    def __init__(self, mesh: Mesh, mask: ArrayLike) -> None:
        """Check the mask, copy and freeze it."""
        check_type("mesh", mesh, Mesh)
        given = read_numbers(mask, "mask")
        if given.dtype != bool or given.shape != (mesh.n_vertices,):
            raise InputError(
                f"mask has shape {given.shape} and type {given.dtype}: give booleans "
                f"({mesh.n_vertices},)"
            )
        object.__setattr__(self, "mesh", mesh)
        object.__setattr__(self, "mask", read_only(given.copy()))

    def __reduce__(self):
        """Pickle the mesh and the mask; loading checks and freezes them again."""
        return Selection, (self.mesh, self.mask)

    @cached_property
    def vertices(self) -> Int[np.ndarray, "chosen"]:
        """Indices of the vertices, in ascending order."""
        return read_only(np.flatnonzero(self.mask))

    def __len__(self) -> int:
        """Return the number of vertices of the selection."""
        return len(self.vertices)

    def __iter__(self) -> Iterator[int]:
        """Return the indices one by one."""
        return iter(self.vertices.tolist())

    def __array__(self, dtype=None, copy: bool | None = None) -> np.ndarray:
        """Return the indices, for NumPy."""
        return np.array(self.vertices, dtype, copy=copy)

    def __invert__(self) -> "Selection":
        """Return all other vertices of the mesh."""
        return Selection(self.mesh, ~self.mask)

    def __or__(self, other: ArrayLike) -> "Selection":
        """Return the vertices of either."""
        return self._joined(other, np.logical_or)

    def __and__(self, other: ArrayLike) -> "Selection":
        """Return the vertices of both."""
        return self._joined(other, np.logical_and)

    def __sub__(self, other: ArrayLike) -> "Selection":
        """Return the vertices of this selection that are not in the other."""
        return self._joined(other, np.greater)

    def __rsub__(self, other: ArrayLike) -> "Selection":
        """Return the vertices of the other that are not in this selection."""
        return self._joined(other, np.less)

    __ror__ = __or__
    __rand__ = __and__

    def _joined(self, other: ArrayLike, join: Callable[..., Any]) -> "Selection":
        return Selection(self.mesh, join(self.mask, read_mask("the other side", other, self.mesh)))

    def __eq__(self, other: object) -> bool:
        """Return whether the other selection has the same vertices, of an equal mesh."""
        if not isinstance(other, Selection):
            return False
        return np.array_equal(self.mask, other.mask) and self.mesh == other.mesh

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return hash((self.mesh, self.mask.tobytes()))

    def __repr__(self) -> str:
        """Return the sizes, not the vertices."""
        return f"Selection({len(self)} of {self.mesh.n_vertices} vertices)"


def read_vertices(
    name: str, value: ArrayLike, mesh: Mesh, unit: str = "vertex"
) -> Int[np.ndarray, "chosen"]:
    """Return vertex indices from indices, a mask or a selection, or raise InputError.

    Indices keep their order and may repeat; those of a mask or a selection are ascending.
    """
    n = mesh.n_vertices
    if isinstance(value, Selection):
        check_same_faces(name, value, mesh)
        return value.vertices
    given = read_numbers(value, name)
    if given.dtype == bool:
        if given.shape != (n,):
            raise InputError(
                f"{name}: the mask has shape {given.shape}: give ({n},), one boolean per vertex, "
                "or vertex indices"
            )
        return np.flatnonzero(given)
    given = read_integers(given, name, "give vertex indices, a mask of booleans or a jd.Selection")
    if given.ndim != 1:
        raise InputError(
            f"{name} {'have' if name.endswith('s') else 'has'} shape {given.shape}: give one list "
            "of vertex indices, a mask of booleans or a jd.Selection"
        )
    check_index(unit, given, n)
    return given


def check_same_faces(name: str, selection: Selection, mesh: Mesh) -> None:
    """Raise InputError unless the selection is of this mesh, or of the same faces elsewhere."""
    other = selection.mesh
    if other.faces is mesh.faces:
        return
    same_size = other.n_vertices == mesh.n_vertices
    if same_size and np.array_equal(other.faces, mesh.faces):
        return
    what = f"{other}, not {mesh}"
    if same_size and other.n_faces == mesh.n_faces:
        what = "its faces name other vertices"
    raise InputError(f"{name}: the selection is of another mesh ({what}): select on this one")


def read_mask_or_numbers(name: str, value: ArrayLike, mesh: Mesh) -> np.ndarray:
    """Return the mask of a selection, or the array that is given instead of one."""
    if isinstance(value, Selection):
        check_same_faces(name, value, mesh)
        return value.mask
    return read_numbers(value, name)


def read_mask(
    name: str, value: ArrayLike, mesh: Mesh, unit: str = "vertex"
) -> Bool[np.ndarray, "vertices"]:
    """Return a mask from indices, a mask or a selection, or raise InputError."""
    mask = np.zeros(mesh.n_vertices, bool)
    mask[read_vertices(name, value, mesh, unit)] = True
    return mask


def check_handles(
    handles: ArrayLike, mesh: Mesh, *, name: str = "handle"
) -> Int[np.ndarray, "handles"]:
    """Return the handle indices as an array, or raise InputError naming what is wrong."""
    given = read_vertices(f"{name}s", handles, mesh, name)
    if given.size == 0:
        empty = f" (the selection is empty: {ranges(mesh)})"
        raise InputError(
            f"no {name}s{empty if isinstance(handles, Selection) else ''}: without one the mesh "
            "could lie anywhere; give at least one"
        )
    unique, count = np.unique(given, return_counts=True)
    if (count > 1).any():
        raise InputError(
            f"vertex {unique[count > 1][0]} is a {name} {count.max()} times: list it once, because "
            "it can have only one target"
        )
    return given


def ranges(mesh: Mesh) -> str:
    """Return the range of each coordinate, for an error about a choice that holds no vertex."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    x, y, z = (f"from {a:.4g} to {b:.4g}" for a, b in zip(low, high, strict=True))
    return f"x runs {x}, y {y}, z {z}"


def check_parts(parts: ArrayLike | None, mesh: Mesh) -> Int[np.ndarray, "vertices"]:
    """Return the part of each vertex, or raise InputError naming what is wrong.

    Without parts the whole mesh is part 0.
    """
    if parts is None:
        return np.zeros(mesh.n_vertices, np.int32)
    given, n = read_mask_or_numbers("parts", parts, mesh), mesh.n_vertices
    label = given.astype(int) if given.dtype == bool else given
    label = read_labels("parts", label, n, "vertex", n)
    missing = np.setdiff1d(np.arange(label.max() + 1), label)
    if missing.size:
        raise InputError(
            f"no vertex belongs to part {missing[0]}, though parts go up to {label.max()}: number "
            "them without gaps, as np.unique(parts, return_inverse=True)[1] does"
        )
    return label.astype(np.int32)
