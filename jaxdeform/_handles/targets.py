"""Targets of handles: translate, rotate, twist and bend a set of points.

Each runs in NumPy and returns a NumPy array, unless the points or the motion are JAX's (a
``jax.Array``, also a traced one): then it runs in JAX, can be differentiated to both, and returns a
``jax.Array``. NumPy needs no compilation, which took 0.5 s for each new number of points.
Values are checked wherever they are known.
"""

import operator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxdeform._arrays import float_type, read_array, read_host_array, read_numbers
from jaxdeform._errors import ArrayLike, InputError, shown
from jaxdeform._linalg.rotations import rotation_matrices
from jaxdeform._values import read_axis

Points = Float[np.ndarray, "points 3"] | Float[Array, "points 3"]

# An angle beyond this has fewer than seven digits after its whole turns are taken off.
_MOST_DEGREES = 1e9


def translate(points: ArrayLike, offset: ArrayLike) -> Points:
    """Return the points moved by an offset (3,), or by one offset each (points, 3).

    **Arguments**: points (points, 3); offset, in the points' unit.

    **Returns** (points, 3), a jax.Array if an argument is one, else a NumPy array.

    **Raises** InputError: another shape; values that are not finite.

    Example:
        >>> import jaxdeform as jd
        >>> jd.translate([[0.0, 0.0, 0.0]], [1.0, 2.0, 3.0]).tolist()
        [[1.0, 2.0, 3.0]]
    """
    xp = _namespace(points, offset)
    points = _points(xp, points)
    offset = _numbers(xp, "offset", offset, points.dtype, (3,), points.shape)
    return run_motion(operator.add, points, xp.broadcast_to(offset, points.shape))


def rotate(
    points: ArrayLike,
    degrees: ArrayLike,
    *,
    axis: str | ArrayLike = "z",
    center: ArrayLike | None = None,
) -> Points:
    """Return the points rotated about an axis through a centre (their centroid if left out).

    **Arguments**: points (points, 3); degrees, a number, counter-clockwise as seen from
    where the axis points to; axis, 'x', 'y', 'z' or a vector (3,) of any length; center (3,).

    **Returns** (points, 3), a jax.Array if points, degrees or center is one, else a NumPy array.

    **Raises** InputError: an axis of length zero; other shapes; values that are not finite; more
    than 1e9 degrees.

    Example:
        >>> import jaxdeform as jd
        >>> jd.rotate([[1.0, 0.0, 0.0]], 90.0, center=[0.0, 0.0, 0.0]).round(6).tolist()
        [[0.0, 1.0, 0.0]]
    """
    xp = _namespace(points, degrees, center)
    points = _points(xp, points)
    if center is not None:
        center = _numbers(xp, "center", center, points.dtype, (3,))
    run = _rotate_compiled if xp is jnp else partial(_rotate, np)
    angle = _degrees(xp, degrees, points.dtype)
    return run_motion(run, points, angle, read_axis("axis", axis), center)


def twist(points: ArrayLike, degrees: ArrayLike = 90.0, *, along: str | ArrayLike = "y") -> Points:
    """Return the points with their upper half rotated about the axis through their centroid.

    Meant for the handles at the two ends of a bar: one end stays, the other rotates rigidly.

    **Arguments**: points (points, 3); degrees; along, the bar's axis: 'x', 'y', 'z' or a vector
    (3,). The halves meet in the middle of the points' extent along it.

    **Returns** (points, 3), a jax.Array if points or degrees is one, else a NumPy array.

    **Raises** InputError: as for `rotate`.

    Example:
        >>> import jaxdeform as jd
        >>> jd.twist([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [-1.0, 2.0, 0.0]], 180.0).shape
        (3, 3)
    """
    xp = _namespace(points, degrees)
    points = _points(xp, points)
    axis = read_axis("along", along)
    run = _twist_compiled if xp is jnp else partial(_twist, np)
    return run_motion(run, points, _degrees(xp, degrees, points.dtype), axis)


def bend(
    points: ArrayLike,
    degrees: ArrayLike = 90.0,
    *,
    along: str | ArrayLike = "y",
    toward: str | ArrayLike = "x",
) -> Points:
    """Return the points with their upper half rotated rigidly about the middle of their extent.

    The bend of thesis Fig. 1.1, for the handles at the two ends of a bar: one end stays where it
    is, the other is rotated with respect to the centre of the bar.

    **Arguments**: points (points, 3); degrees; along, the bar's axis; toward, the axis that its
    upper end bends to; each 'x', 'y', 'z' or a vector (3,).

    **Returns** (points, 3), a jax.Array if points or degrees is one, else a NumPy array.

    **Raises** InputError: along and toward are parallel; else as for `rotate`.

    Example:
        >>> import jaxdeform as jd
        >>> jd.bend([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]], 90.0).round(6).tolist()
        [[0.0, 0.0, 0.0], [2.0, 2.0, 0.0]]
    """
    xp = _namespace(points, degrees)
    points = _points(xp, points)
    up, side = read_axis("along", along), read_axis("toward", toward)
    normal = np.cross(up, side)
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise InputError(
            f"along is {shown(along)} and toward {shown(toward)}: a bar bends towards another axis "
            "than its own"
        )
    run = _bend_compiled if xp is jnp else partial(_bend, np)
    return run_motion(run, points, _degrees(xp, degrees, points.dtype), up, normal / length)


# ---------------------------------------------------------------- checks of the arguments


def _namespace(*arguments):
    return jnp if any(isinstance(x, jax.Array) for x in arguments) else np


def _points(xp, points: ArrayLike) -> Points:
    if isinstance(points, jax.Array):
        array = read_array(points, float_type(points), "points")
    else:
        array = read_numbers(points, "points")
        # Whole numbers, long doubles and other byte orders become what JAX can take too.
        single = array.dtype.kind == "f" and array.dtype.itemsize <= 4
        array = read_host_array(array, np.float32 if single else np.float64, "points")
    if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] == 0:
        raise InputError(
            f"points have shape {array.shape}: give one row (x, y, z) per point, at least one"
        )
    if not isinstance(array, Tracer):
        bad = np.flatnonzero(~np.isfinite(np.asarray(array)).all(axis=1))
        if bad.size:
            row = np.asarray(array)[bad[0]].tolist()
            raise InputError(f"points: point {bad[0]} is {row}: give finite numbers")
    return xp.asarray(array)


def _numbers(xp, name: str, value: ArrayLike, dtype, *shapes: tuple[int, ...]):
    array = (read_array if xp is jnp else read_host_array)(value, dtype, name)
    if array.shape not in shapes:
        allowed = " or ".join(str(shape) if shape else "one number" for shape in shapes)
        raise InputError(f"{name} has shape {array.shape}: give {allowed}")
    if not isinstance(array, Tracer) and not np.isfinite(np.asarray(array)).all():
        raise InputError(f"{name} is {shown(np.asarray(array))}: give finite numbers")
    return xp.asarray(array)


def _degrees(xp, degrees: ArrayLike, dtype):
    array = _numbers(xp, "degrees", degrees, dtype, ())
    if not isinstance(array, Tracer):
        check_angle("degrees is", float(array))
    return array


def check_angle(what: str, degrees: float) -> None:
    """Raise InputError for an angle that its whole turns leave without digits."""
    if abs(degrees) > _MOST_DEGREES:
        raise InputError(
            f"{what} {degrees:g}, of which rounding leaves no angle: give at most {_MOST_DEGREES:g}"
        )


def run_motion(motion, points, *arguments) -> Points:
    """Move the points, or raise InputError if they overflow."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = motion(points, *arguments)
    if not isinstance(moved, Tracer) and not np.isfinite(np.asarray(moved)).all():
        raise InputError(
            "the moved points overflow: give a smaller motion, or points in a larger unit"
        )
    return moved


# ---------------------------------------------------------------- the motions


def _rotate(xp, points, degrees, axis, center):
    center = points.mean(axis=0) if center is None else center
    # Whole turns are taken off first; the derivative is that of the angle itself.
    angle = xp.deg2rad(xp.fmod(degrees, xp.asarray(360.0, points.dtype)))
    rotation = rotation_matrices((angle * xp.asarray(axis, points.dtype))[None])[0]
    return (points - center[None]) @ rotation.T + center[None]


def _rotate_upper(xp, points, degrees, along, axis, center):
    height = points @ xp.asarray(along, points.dtype)
    upper = height > _halfway(height)
    return xp.where(upper[:, None], _rotate(xp, points, degrees, axis, center), points)


def _twist(xp, points, degrees, axis):
    return _rotate_upper(xp, points, degrees, axis, axis, points.mean(axis=0))


def _bend(xp, points, degrees, along, axis):
    return _rotate_upper(xp, points, degrees, along, axis, _halfway(points))


def _halfway(values):
    return (values.min(axis=0) + values.max(axis=0)) / 2


# Compiled whole, because operation by operation a first bend takes 0.9 s instead of 0.2.
_rotate_compiled = jax.jit(partial(_rotate, jnp))
_twist_compiled = jax.jit(partial(_twist, jnp))
_bend_compiled = jax.jit(partial(_bend, jnp))
