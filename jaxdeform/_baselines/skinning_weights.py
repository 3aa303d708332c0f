"""Skinning weights: rigid, inverse distance, bounded biharmonic (thesis chapter 3)."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._arrays import as_array, is_concrete
from jaxdeform._checks import check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._handles.split import check_components
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.selection import check_handles
from jaxdeform._values import read_jax_positions, read_labels, read_rows


def rigid_weights(
    vertices: ArrayLike, controls: ArrayLike, *, distances: ArrayLike | None = None
) -> Float[Array, "vertices controls"]:
    """Return weight 1 for the nearest control and 0 for the others (thesis chapter 3).

    If several controls are equally near, the first gets all the weight, so each row sums to one.

    **Arguments**: vertices, controls and distances as in `inverse_distance_weights`.

    **Returns** (vertices, controls) weights.

    **Raises** InputError as `inverse_distance_weights`.

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
) -> Float[Array, "vertices controls"]:
    """Return weights proportional to ``1 / distance^power``, with sum one (thesis chapter 3).

    A vertex on a control belongs to it alone; a vertex on several controls is shared equally. JAX
    can trace this function, and it is differentiable in all arguments.

    **Arguments**

    - vertices: (vertices, 3).
    - controls: points (controls, 3), or bones (controls, 2, 3), whose distance is that of the
      segment.
    - power: a number above 0. A larger power gives weights closer to `rigid_weights`.
    - distances: (vertices, controls), used instead of Euclidean distances; for instance from
      `geodesic_distances`.

    **Returns** (vertices, controls) weights.

    **Raises** InputError: a shape is wrong; a value is not finite; a bone has length zero; the
    power is 0 or less; a vertex is at infinite distance from every control.

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
    # Use a softmax of logarithms, because 1 / d^power overflows for small d.
    logits = -0.5 * power * jnp.log(jnp.where(on, 1.0, squares))
    hits = jnp.sum(on, axis=1, keepdims=True, dtype=squares.dtype)
    alone = on.astype(squares.dtype) / jnp.maximum(hits, 1.0)
    return jnp.where(hits > 0, alone, jax.nn.softmax(logits, axis=1))


def bounded_biharmonic_weights(
    mesh: Mesh, handles: ArrayLike, group: ArrayLike | None = None
) -> Float[Array, "vertices controls"]:
    """Return bounded biharmonic weights on the surface of a mesh.

    ``w_j`` minimises ``integral |Laplacian w_j|^2`` with ``0 <= w_j <= 1``. It is 1 on the handles
    of control j and 0 on those of the other controls. Each row is then divided by its sum, which is
    near one. The weights are smooth and follow the shape. The paper solves for them in the volume;
    here the domain is the surface, so the controls are vertices of it.

    Jacobson, Baran, Popovic and Sorkine, "Bounded biharmonic weights for real-time deformation"
    (2011), doi:10.1145/2010324.1964973.

    **Arguments**

    - mesh: the surface, closed or open.
    - handles: (handles,), vertex indices, a mask or a selection.
    - group: (handles,), the control of each handle, numbered from 0; by default each handle is a
      control.

    **Returns** (vertices, controls) weights.

    **Raises** InputError: a handle is out of range or repeated; a group has no handles; a connected
    component has no handle; a vertex belongs to no face (libigl would crash or return NaN).

    Example:
        >>> import jaxdeform as jd
        >>> jd.bounded_biharmonic_weights(jd.shapes.bar(), [0, 721]).shape
        (722, 2)
    """
    check_type("mesh", mesh, Mesh)
    index = check_handles(handles, mesh)
    count = len(index)
    given = np.arange(count) if group is None else group
    group = read_labels("group", given, count, "handle", count)
    count = int(group.max()) + 1
    empty = np.setdiff1d(np.arange(count), group)
    if empty.size:
        raise InputError(f"group {empty[0]} has no handles: number the groups from 0, without gaps")
    if not mesh.referenced.all():
        raise InputError(
            f"vertex {np.flatnonzero(~mesh.referenced)[0]} belongs to no face, so no weight "
            "reaches it: drop such vertices with jd.repair(mesh)"
        )
    check_components(mesh, index)
    # Scale to unit size, because the tolerances of libigl are absolute.
    points = mesh.vertices - mesh.vertices.mean(axis=0)
    points = points / np.abs(points).max()
    faces = np.ascontiguousarray(mesh.solid_faces)
    try:
        weights = np.clip(igl.bbw(points, faces, index, np.eye(count)[group]), 0.0, 1.0)
    except RuntimeError:  # all that libigl says is that it failed
        weights = np.zeros((mesh.n_vertices, count))
    total = weights.sum(axis=1, keepdims=True)
    if not np.isfinite(total).all() or total.min() < 0.1:
        raise InputError(
            "the biharmonic system could not be solved, because some triangles are too thin: see "
            "jd.inspect(mesh)"
        )
    return jnp.asarray(weights / total, jnp.result_type(float))


def _squares(vertices, controls, distances) -> Float[Array, "vertices controls"]:
    """Return squared distances to points or segments, or the squares of given distances."""
    dtype = jnp.result_type(float)
    vertices = read_rows("vertices", vertices, dtype)
    ends = as_array(controls, dtype, "controls")
    if ends.ndim not in (2, 3) or ends.shape[1:] not in ((3,), (2, 3)) or not len(ends):
        raise InputError(
            f"controls have shape {ends.shape}: give points (controls, 3) or bones "
            "(controls, 2, 3), at least one"
        )
    ends = read_jax_positions("controls", ends, ends.shape, dtype, unit="control")
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
            "different ends, or points (controls, 3)"
        )
    arm = vertices[:, None] - ends[None, :, 0]
    fraction = jnp.clip(
        jnp.einsum("nmi,mi->nm", arm, along / square[:, None], precision="highest"), 0.0, 1.0
    )
    return jnp.sum((arm - fraction[:, :, None] * along[None]) ** 2, axis=2)


def _given_squares(distances: Array, shape: tuple[int, int]) -> Float[Array, "vertices controls"]:
    if distances.shape != shape:
        raise InputError(
            f"distances have shape {distances.shape}: give {shape}, vertices by controls"
        )
    if is_concrete(distances):
        values = np.asarray(distances)
        bad = np.argwhere(~(values >= 0))
        if bad.size:
            i, j = bad[0]
            raise InputError(
                f"the distance of vertex {i} to control {j} is {values[i, j]}: give 0 or more"
            )
        far = np.flatnonzero(np.isinf(values).all(axis=1))
        if far.size:
            raise InputError(
                f"vertex {far[0]} is connected to no control: put one on its connected component"
            )
    return distances**2
