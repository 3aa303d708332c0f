"""Weights of skinning: rigid, inverse distance, bounded biharmonic (thesis chapter 3)."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._mesh.mesh import Mesh
from jaxdeform.checks import (
    as_array,
    check_components,
    check_groups,
    check_handles,
    check_positions,
    is_concrete,
    rows_of_three,
)
from jaxdeform.errors import ArrayLike, InputError


def rigid_weights(
    vertices: ArrayLike, controls: ArrayLike, *, distances: ArrayLike | None = None
) -> Float[Array, "n m"]:
    """Return weight 1 for the nearest control and 0 for the others (thesis chapter 3).

    Of controls equally near, the first takes all, so that the weights sum to one.

    **Arguments** as in :func:`inverse_distance_weights`, but for the power.

    **Raises** InputError as there.

    Example:
        >>> import jaxdeform as jd
        >>> jd.rigid_weights([[0.0, 1.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]).tolist()
        [[1.0, 0.0]]
    """
    squares = _squares(vertices, controls, distances)
    return jax.nn.one_hot(jnp.argmin(squares, axis=1), squares.shape[1], dtype=squares.dtype)


def inverse_distance_weights(
    vertices: ArrayLike,
    controls: ArrayLike,
    power: ArrayLike = 2.0,
    *,
    distances: ArrayLike | None = None,
) -> Float[Array, "n m"]:
    """Return weights proportional to ``1 / distance^power``, with sum one (thesis chapter 3).

    A vertex on a control belongs to it alone (in equal parts to all that it lies on). Traceable,
    and differentiable to all arguments.

    **Arguments**

    - vertices: (n, 3).
    - controls: points (m, 3), or bones (m, 2, 3), whose distance is that of the segment.
    - power: a number > 0; the larger, the closer to :func:`rigid_weights`.
    - distances: (n, m), used instead of the Euclidean ones, as from :func:`geodesic_distances`.

    **Raises** InputError: wrong shapes; values that are not finite; a bone of length zero; a power
    of 0 or less; a vertex at infinite distance from every control.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> ends = [[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
        >>> weights = jd.inverse_distance_weights([[0.0, 1.0, 0.0]], ends)
        >>> np.allclose(weights, [[0.9, 0.1]])
        True
    """
    squares = _squares(vertices, controls, distances)
    power = as_array(power, squares.dtype, "power")
    if power.ndim or (is_concrete(power) and not (0 < float(power) < np.inf)):
        raise InputError(f"power is {power}: give one finite number above 0")
    on = squares == 0
    # A softmax of logarithms, because 1 / d^power overflows for small d.
    logits = -0.5 * power * jnp.log(jnp.where(on, 1.0, squares))
    hits = jnp.sum(on, axis=1, keepdims=True, dtype=squares.dtype)
    alone = on.astype(squares.dtype) / jnp.maximum(hits, 1.0)
    return jnp.where(hits > 0, alone, jax.nn.softmax(logits, axis=1))


def geodesic_distances(mesh: Mesh, sources: ArrayLike) -> Float[np.ndarray, "n m"]:
    """Return the distance along the surface from every vertex to each of m vertices.

    Exact on the polyhedron (Mitchell et al. 1987; libigl). Infinite between parts of the mesh that
    are not connected. On a cactus of 5,300 vertices a source takes 0.7 s.

    **Arguments**: mesh; sources (m,) vertex indices.

    **Raises** InputError: a source out of range or repeated; a mesh with an edge of more than two
    faces, or whose surfaces meet in a single vertex (libigl would crash or return zeros).

    Example:
        >>> import jaxdeform as jd
        >>> jd.geodesic_distances(jd.shapes.square(), [4])[0].round(6).tolist()
        [1.414214]
    """
    index = check_handles(sources, mesh.n_vertices)
    faces = np.ascontiguousarray(mesh.faces)
    used = np.unique(faces)
    if not (igl.is_edge_manifold(faces)[0] and np.ravel(igl.is_vertex_manifold(faces))[used].all()):
        raise InputError("geodesic distances need a manifold surface: see jd.inspect(mesh)")
    label = mesh.components
    out = np.full((mesh.n_vertices, len(index)), np.inf)
    none = np.array([], np.int64)
    for k, source in enumerate(index):
        # libigl says 0 where there is no way, so only those with one are asked for.
        reached = np.flatnonzero(label == label[source])
        if len(reached) > 1:
            out[reached, k] = igl.exact_geodesic(
                mesh.vertices, faces, np.array([source]), none, reached, none
            )
        out[source, k] = 0.0
    return out


def bounded_biharmonic_weights(
    mesh: Mesh, handles: ArrayLike, group: ArrayLike | None = None
) -> Float[Array, "n m"]:
    """Return bounded biharmonic weights (Jacobson et al. 2011) on the surface of a mesh.

    ``w_j`` minimises ``integral |Laplacian w_j|^2`` with ``0 <= w_j <= 1``, 1 on its own handles
    and 0 on those of the others; the rows are then divided by their sums, which are near one. They
    are smooth and follow the shape. The paper solves them in the volume; here the domain is the
    surface, so controls are vertices of it.

    **Arguments**

    - mesh: the surface, closed or open.
    - handles: (h,) vertex indices.
    - group: (h,) the control that each handle belongs to, 0 to m - 1; each its own if left out.

    **Raises** InputError: a handle out of range or repeated; a group without handles; a connected
    part without handles; unreferenced vertices (all of which crash libigl or come out as NaN).

    Example:
        >>> import jaxdeform as jd
        >>> jd.bounded_biharmonic_weights(jd.shapes.bar(), [0, 721]).shape
        (722, 2)
    """
    index = check_handles(handles, mesh.n_vertices)
    group = np.arange(len(index)) if group is None else check_groups(group, len(index))
    count = int(group.max()) + 1
    empty = np.setdiff1d(np.arange(count), group)
    if empty.size:
        raise InputError(f"group {empty[0]} has no handles: number the groups 0 to m - 1")
    if not mesh.referenced.all():
        raise InputError(
            f"vertex {np.flatnonzero(~mesh.referenced)[0]} belongs to no face, so no weight "
            "reaches it: drop such vertices with jd.repair(mesh)"
        )
    check_components(mesh, index)
    # To unit size, because libigl's tolerances are absolute.
    points = mesh.vertices - mesh.vertices.mean(axis=0)
    points = points / np.abs(points).max()
    weights = igl.bbw(points, np.ascontiguousarray(mesh.faces), index, np.eye(count)[group])
    weights = np.clip(weights, 0.0, 1.0)
    total = weights.sum(axis=1, keepdims=True)
    if not np.isfinite(total).all() or total.min() < 0.1:
        raise InputError(
            "the biharmonic system could not be solved: the mesh has triangles too thin for it; "
            "see jd.inspect(mesh)"
        )
    return jnp.asarray(weights / total, jnp.result_type(float))


def _squares(vertices, controls, distances) -> Float[Array, "n m"]:
    """Squared distances from vertices to points or segments, or those that were given."""
    dtype = jnp.result_type(float)
    vertices = rows_of_three("vertices", vertices, dtype)
    ends = as_array(controls, dtype, "controls")
    if ends.ndim not in (2, 3) or ends.shape[1:] not in ((3,), (2, 3)) or not len(ends):
        raise InputError(
            f"controls have shape {ends.shape}: give points (m, 3) or bones (m, 2, 3), m >= 1"
        )
    ends = check_positions("controls", ends, ends.shape, dtype, unit="control")
    n, m = len(vertices), len(ends)
    if distances is not None:
        return _given_squares(as_array(distances, dtype, "distances"), (n, m))
    if ends.ndim == 2:
        return jnp.sum((vertices[:, None] - ends[None]) ** 2, axis=2)
    along = ends[:, 1] - ends[:, 0]
    square = jnp.sum(along**2, axis=1)
    if is_concrete(square) and not np.asarray(square).all():
        raise InputError(
            f"bone {np.flatnonzero(np.asarray(square) == 0)[0]} has length zero: give two "
            "different ends, or points (m, 3)"
        )
    arm = vertices[:, None] - ends[None, :, 0]
    part = jnp.clip(
        jnp.einsum("nmi,mi->nm", arm, along / square[:, None], precision="highest"), 0.0, 1.0
    )
    return jnp.sum((arm - part[:, :, None] * along[None]) ** 2, axis=2)


def _given_squares(distances: Array, shape: tuple[int, int]) -> Float[Array, "n m"]:
    if distances.shape != shape:
        raise InputError(
            f"distances have shape {distances.shape}, expected {shape}: vertices by controls"
        )
    if is_concrete(distances):
        values = np.asarray(distances)
        bad = np.argwhere(~(values >= 0))
        if bad.size:
            i, j = bad[0]
            raise InputError(f"the distance of vertex {i} to control {j} is {values[i, j]}")
        far = np.flatnonzero(np.isinf(values).all(axis=1))
        if far.size:
            raise InputError(
                f"vertex {far[0]} is connected to no control: put one on its part of the mesh"
            )
    return distances**2
