"""Targets of handle groups that move rigidly."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdeform._arrays import float_type, is_concrete
from jaxdeform._errors import ArrayLike
from jaxdeform._handles.targets import check_angle, run_motion
from jaxdeform._linalg.rotations import rotation_matrices
from jaxdeform._values import read_jax_positions, read_labels, read_rows


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
      in radians, at most 1e9 degrees.
    - translations: (groups, 3), in the unit of the points.
    - centers: (groups, 3), the centre of each rotation; by default the centroid of each group.

    **Returns** (handles, 3).

    **Raises** InputError: shapes that do not fit together; values that are not finite; a group out
    of range; more than 1e9 degrees; targets that overflow.

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
    points = read_rows("points", points, dtype, unit="handle")
    rotations = read_rows("rotations", rotations, dtype, unit="group")
    if is_concrete(rotations):
        _check_angles(np.asarray(rotations, np.float64))
    shape = rotations.shape
    translations = read_jax_positions("translations", translations, shape, dtype, unit="group")
    group = read_labels("group", group, len(points), "handle", len(rotations))
    if centers is not None:
        centers = read_jax_positions("centers", centers, shape, dtype, unit="group")
    return jnp.asarray(run_motion(_moved, points, group, rotations, translations, centers))


def _check_angles(rotations: Float[np.ndarray, "groups 3"]) -> None:
    with np.errstate(over="ignore"):
        x, y, z = np.degrees(rotations).T
        angles = np.hypot(np.hypot(x, y), z)
    most = int(angles.argmax())
    check_angle(f"in degrees, the rotation of group {most} is by", float(angles[most]))


def _moved(
    points: Float[Array, "handles 3"],
    group: Int[np.ndarray, "handles"],
    rotations: Float[Array, "groups 3"],
    translations: Float[Array, "groups 3"],
    centers: Float[Array, "groups 3"] | None,
) -> Float[Array, "handles 3"]:
    shape, dtype = rotations.shape, points.dtype
    if centers is None:
        size = np.maximum(np.bincount(group, minlength=len(rotations)), 1)
        total = jnp.zeros(shape, dtype).at[group].add(points)
        centers = total / jnp.asarray(size, dtype)[:, None]
    moved = jnp.einsum(
        "hij,hj->hi",
        rotation_matrices(rotations)[group],
        points - centers[group],
        precision="highest",
    )
    return moved + (centers + translations)[group]
