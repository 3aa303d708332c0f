"""Targets of handle groups that move rigidly."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._checks import as_array, check_groups, check_positions
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._linalg.rotations import rotation_matrices


def rigid_targets(
    points: ArrayLike,
    group: ArrayLike,
    rotations: ArrayLike,
    translations: ArrayLike,
    centers: ArrayLike | None = None,
) -> Float[Array, "handles 3"]:
    """Return the targets of handle groups, each of which moves as a rigid body.

    ``target = R_g (p - center_g) + center_g + t_g``. A rotation is given as a rotation vector. It
    is smooth at zero, so rotations and translations have gradients everywhere.

    **Arguments**

    - points: (handles, 3), rest positions of the handles.
    - group: (handles,), the group of each handle, from 0.
    - rotations: (groups, 3), rotation vectors: the direction is the axis, the length is the angle
      in radians.
    - translations: (groups, 3), in the unit of the points.
    - centers: (groups, 3), the centre of each rotation; by default the centroid of each group.

    **Returns** (handles, 3).

    **Raises** InputError: shapes that do not fit together; values that are not finite; a group out
    of range.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> points = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        >>> rotation = [[0.0, 0.0, np.pi / 2]]
        >>> moved = jd.rigid_targets(points, [0, 0], rotation, [[0.0, 0.0, 5.0]])
        >>> np.allclose(moved, [[0.0, 1.0, 5.0], [0.0, -1.0, 5.0]], atol=1e-6)
        True
    """
    points = jnp.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points have shape {points.shape}: give (handles, 3)")
    # Positions may be integers, but rotations must not be rounded to integers.
    dtype = points.dtype if points.dtype.kind == "f" else jnp.result_type(float)
    points = check_positions("points", points, points.shape, dtype, unit="handle")
    rotations = as_array(rotations, dtype, "rotations")
    if rotations.ndim != 2 or rotations.shape[1] != 3:
        raise InputError(
            f"rotations have shape {rotations.shape}: give (groups, 3) rotation vectors"
        )
    shape = rotations.shape
    rotations = check_positions("rotations", rotations, shape, dtype, unit="group")
    translations = check_positions("translations", translations, shape, dtype, unit="group")
    group = check_groups(group, len(points))
    if len(group) and group.max() >= len(rotations):
        raise InputError(
            f"group {group.max()} is out of range: there are rotations for groups 0 to "
            f"{len(rotations) - 1}"
        )
    if centers is None:
        size = np.maximum(np.bincount(group, minlength=len(rotations)), 1)
        total = jnp.zeros(shape, dtype).at[group].add(points)
        centers = total / jnp.asarray(size, dtype)[:, None]
    else:
        centers = check_positions("centers", centers, shape, dtype, unit="group")
    moved = jnp.einsum(
        "hij,hj->hi",
        rotation_matrices(rotations)[group],
        points - centers[group],
        precision="highest",
    )
    return moved + (centers + translations)[group]
