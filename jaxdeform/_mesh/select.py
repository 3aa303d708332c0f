"""Choose vertices without their numbers, by place, distance, connection or an expression.

Each function returns a `Selection`, which ``|``, ``&``, ``-`` and ``~`` combine.
"""

import numpy as np

from jaxdeform._arrays import read_host_array
from jaxdeform._checks import check_count, check_tolerance, check_type
from jaxdeform._errors import ArrayLike, InputError, shown
from jaxdeform._mesh.expressions import matching
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.nearby import within_distance
from jaxdeform._mesh.selection import Selection, ranges, read_mask, read_vertices
from jaxdeform._values import read_axis

__all__ = [
    "border",
    "box",
    "component",
    "halfspace",
    "mask",
    "nearest",
    "sphere",
    "where",
    "within",
]


def __dir__() -> list[str]:
    """Return what tab completion offers: no helpers."""
    return __all__


def where(mesh: Mesh, expression: str) -> Selection:
    """Select the vertices where an expression of their coordinates holds.

    ``x``, ``y`` and ``z`` are the coordinates, in the unit of the mesh. ``u``, ``v`` and ``w`` are
    the same as fractions of the bounding box, from 0 to 1: ``v > 0.9`` is the upper tenth. There
    are the comparisons ``< <= > >= == !=``, also in chains (``0 < y <= 3``), ``and``, ``or``,
    ``not``, parentheses, numbers, and ``+ - * /``: ``x*x + z*z < 4``. They bind as in Python, but
    the expression is never run as Python.

    **Arguments**: mesh; expression, a text.

    **Returns** a `Selection`, which may be empty.

    **Raises** InputError: the expression cannot be read (a note shows the place by a caret); a
    division by zero, or an overflow; u, v or w where the mesh is flat.

    Example:
        >>> import jaxdeform as jd
        >>> jd.select.where(jd.shapes.bar(), "y < 6 or v > 0.9 and not x < 0")
        Selection(127 of 722 vertices)
    """
    check_type("mesh", mesh, Mesh)
    return Selection(mesh, matching(mesh, expression, "expression"))


def box(mesh: Mesh, low: ArrayLike, high: ArrayLike) -> Selection:
    """Select the vertices in a box along the axes, its faces included.

    **Arguments**: mesh; low and high, the corners (3,) in the unit of the mesh. Infinity leaves a
    side open.

    **Returns** a `Selection`, which may be empty.

    **Raises** InputError: a corner of another shape or with NaN; low above high.

    Example:
        >>> import jaxdeform as jd
        >>> jd.select.box(jd.shapes.bar(), [-15, 0, -15], [0, 6, 15])
        Selection(41 of 722 vertices)
    """
    check_type("mesh", mesh, Mesh)
    low, high = _point("low", low, endless=True), _point("high", high, endless=True)
    for axis in np.flatnonzero(low > high)[:1]:
        raise InputError(
            f"low is {low[axis]:g} along {'xyz'[axis]}, above high, {high[axis]:g}: swap them"
        )
    inside = (low <= mesh.vertices) & (mesh.vertices <= high)
    return Selection(mesh, np.asarray(inside.all(axis=1)))


def halfspace(
    mesh: Mesh,
    axis: str | ArrayLike,
    *,
    above: ArrayLike | None = None,
    below: ArrayLike | None = None,
) -> Selection:
    """Select the vertices on one side of a plane, or between two parallel planes.

    **Arguments**

    - mesh.
    - axis: the direction of the planes' normal: 'x', 'y', 'z' or a vector (3,) of any length.
    - above, below: a plane each, of which one may be left out: its distance from the origin along
      the axis, in the unit of the mesh, or a point (3,) on it. Vertices on a plane are left out.

    **Returns** a `Selection`, which may be empty.

    **Raises** InputError: neither plane is given; an axis of length zero; other shapes; values that
    are not finite.

    Example:
        >>> import jaxdeform as jd
        >>> jd.select.halfspace(jd.shapes.bar(), "y", below=6)
        Selection(73 of 722 vertices)
    """
    check_type("mesh", mesh, Mesh)
    if above is None and below is None:
        raise InputError("above and below are None: give one of them, such as above=0.5")
    normal = read_axis("axis", axis)
    height = mesh.vertices @ normal
    inside = np.ones(mesh.n_vertices, bool)
    if above is not None:
        inside &= height > _height("above", above, normal)
    if below is not None:
        inside &= height < _height("below", below, normal)
    return Selection(mesh, inside)


def sphere(mesh: Mesh, center: ArrayLike, radius: float) -> Selection:
    """Select the vertices in a sphere, its surface included. For distances along the surface of the
    mesh see `within`.

    **Arguments**: mesh; center (3,); radius, 0 or more; both in the unit of the mesh.

    **Returns** a `Selection`, which may be empty.

    **Raises** InputError: another shape; values that are not finite; a negative radius.

    Example:
        >>> import jaxdeform as jd
        >>> jd.select.sphere(jd.shapes.bar(), [0, 0, 0], 5)
        Selection(5 of 722 vertices)
    """
    check_type("mesh", mesh, Mesh)
    far = _distances(mesh, _point("center", center))
    return Selection(mesh, far <= check_tolerance("radius", radius))


def nearest(mesh: Mesh, point: ArrayLike, count: int = 1) -> Selection:
    """Select the vertices nearest to a point, in a straight line.

    Of vertices that are equally near, those with the lowest indices are taken.

    **Arguments**: mesh; point (3,), in the unit of the mesh; count, how many vertices.

    **Returns** a `Selection` of exactly that many vertices.

    **Raises** InputError: another shape; values that are not finite; a count above the number of
    vertices.

    Example:
        >>> import jaxdeform as jd
        >>> jd.select.nearest(jd.shapes.square(), [0.1, 0.1, 0.0], 1).vertices
        array([4])
    """
    check_type("mesh", mesh, Mesh)
    count = check_count("count", count, most=mesh.n_vertices)
    order = np.argsort(_distances(mesh, _point("point", point)), kind="stable")
    return Selection(mesh, read_mask("point", order[:count], mesh))


def within(mesh: Mesh, sources: ArrayLike, distance: float) -> Selection:
    """Select the vertices within a distance of some vertices, along the surface.

    Exact geodesic distance, as of `geodesic_distances`; other connected components
    are never within reach.

    **Arguments**: mesh; sources, vertex indices, a mask or a selection; distance, 0 or more, in the
    unit of the mesh.

    **Returns** a `Selection`, which has the sources too.

    **Raises** InputError: no sources; a source out of range; a distance that is negative or not
    finite; a surface that is not manifold, or has faces too flat (see `geodesic_distances`).

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> jd.select.within(mesh, jd.select.nearest(mesh, [0, 151, 0]), 15)
        Selection(29 of 722 vertices)
    """
    check_type("mesh", mesh, Mesh)
    index = _some("sources", sources, mesh, "source")
    return Selection(mesh, within_distance(mesh, index, check_tolerance("distance", distance)))


def component(mesh: Mesh, vertices: ArrayLike) -> Selection:
    """Select the connected components that some vertices belong to.

    **Arguments**: mesh; vertices, one vertex index, a list of them, a mask or a selection.

    **Returns** a `Selection`.

    **Raises** InputError: no vertices; an index out of range.

    Example:
        >>> import jaxdeform as jd
        >>> jd.select.component(jd.shapes.bar(), 0)
        Selection(722 of 722 vertices)
    """
    check_type("mesh", mesh, Mesh)
    if isinstance(vertices, int | np.integer) and not isinstance(vertices, bool):
        vertices = [int(vertices)]
    index = _some("vertices", vertices, mesh, "vertex")
    return Selection(mesh, np.isin(mesh.components, mesh.components[index]))


def border(mesh: Mesh) -> Selection:
    """Select the vertices on the border, where an edge has one face only.

    **Arguments**: mesh. Faces without an area count too: they close the surface.

    **Returns** a `Selection`, empty for a closed mesh.

    **Raises** InputError: mesh is no jd.Mesh.

    Example:
        >>> import jaxdeform as jd
        >>> ~jd.select.border(jd.shapes.square())
        Selection(1 of 9 vertices)
    """
    check_type("mesh", mesh, Mesh)
    sides = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, times = np.unique(sides, axis=0, return_counts=True)
    return Selection(mesh, read_mask("border", edges[times == 1].ravel(), mesh))


def mask(mesh: Mesh, mask: ArrayLike) -> Selection:
    """Select the vertices where a mask is True.

    **Arguments**: mesh; mask, booleans (vertices,).

    **Returns** a `Selection`, which may be empty.

    **Raises** InputError: another shape; values that are not booleans.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> jd.select.mask(mesh, mesh.vertices[:, 1] < 6)
        Selection(73 of 722 vertices)
    """
    return Selection(mesh, mask)


def some_where(mesh: Mesh, expression: object, name: str) -> Selection:
    """Return the vertices where an expression holds, or raise InputError if it holds nowhere."""
    chosen = Selection(mesh, matching(mesh, expression, name))
    if not len(chosen):
        raise InputError(f"{name}: {shown(expression)} holds for no vertex: {ranges(mesh)}")
    return chosen


def _some(name: str, value: ArrayLike, mesh: Mesh, unit: str) -> np.ndarray:
    index = read_vertices(name, value, mesh, unit)
    if not index.size:
        raise InputError(f"{name} has no vertex: give at least one ({ranges(mesh)})")
    return index


def _point(name: str, value: ArrayLike, *, endless: bool = False) -> np.ndarray:
    point = read_host_array(value, np.float64, name)
    if point.shape != (3,) or np.isnan(point).any() or not (endless or np.isfinite(point).all()):
        kind = "three numbers" if endless else "three finite numbers"
        raise InputError(f"{name} is {shown(value)}: give a point, {kind}")
    return point


def _height(name: str, value: ArrayLike, normal: np.ndarray) -> float:
    """Return the place of a plane along its normal, from that place or a point on the plane."""
    given = read_host_array(value, np.float64, name)
    if given.shape not in ((), (3,)) or not np.isfinite(given).all():
        raise InputError(
            f"{name} is {shown(value)}: give a finite number, or a point of three on the plane"
        )
    return float(given @ normal if given.ndim else given)


def _distances(mesh: Mesh, point: np.ndarray) -> np.ndarray:
    return np.linalg.norm(mesh.vertices - point, axis=1)
