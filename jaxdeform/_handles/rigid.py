"""Targets of handle groups that move rigidly."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._arrays import float_type
from jaxdeform._checks import check_labels, check_positions, rows_of_three
from jaxdeform._errors import ArrayLike
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
    # The points give the type, unless they are integers: rotations must not be rounded to those.
    dtype = float_type(points)
    points = rows_of_three("points", points, dtype, unit="handle")
    rotations = rows_of_three("rotations", rotations, dtype, unit="group")
    shape = rotations.shape
    translations = check_positions("translations", translations, shape, dtype, unit="group")
    group = check_labels("group", group, len(points), "handle", len(rotations))
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
