"""Linear blend and dual quaternion skinning: p'_i = sum_j w_ij T_j p_i (thesis chapter 3)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._arrays import as_array, is_concrete
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._handles.targets import check_angle
from jaxdeform._linalg.rotations import (
    matrices_from_quaternions,
    quaternion_product,
    quaternions_from_matrices,
    rotation_matrices,
)
from jaxdeform._values import read_jax_positions, read_rows


def rigid_transforms(
    rotations: ArrayLike, translations: ArrayLike, centers: ArrayLike
) -> Float[Array, "controls 3 4"]:
    """Return the matrix of ``p -> R (p - center) + center + t`` for each control.

    **Arguments**

    - rotations: (controls, 3), rotation vectors: the direction is the axis, the length is the angle
      in radians.
    - translations: (controls, 3).
    - centers: (controls, 3), the centre of each rotation.

    **Returns** (controls, 3, 4): rotation and shift.

    **Raises** InputError: shapes that differ; values that are not finite; angles so large that
    rounding leaves nothing of them; motions that overflow.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> moves = jd.rigid_transforms([[0, 0, np.pi]], [[0, 0, 0]], [[1, 0, 0]])
        >>> np.allclose(moves[0, :, 3], [2.0, 0.0, 0.0], atol=1e-6)
        True
    """
    dtype = jnp.result_type(float)
    rotations = read_rows("rotations", rotations, dtype, unit="control")
    shape = rotations.shape
    translations = read_jax_positions("translations", translations, shape, dtype, unit="control")
    centers = read_jax_positions("centers", centers, shape, dtype, unit="control")
    if is_concrete(rotations):
        with np.errstate(over="ignore"):
            angles = np.degrees(np.linalg.norm(rotations, axis=1))
        check_angle("rotations turn by", angles.max(initial=0.0))
    turned = rotation_matrices(rotations)
    shift = centers + translations
    shift = shift - jnp.einsum("mij,mj->mi", turned, centers, precision="highest")
    if is_concrete(shift) and not np.isfinite(shift).all():
        raise InputError(
            "translations and centers overflow: give smaller ones, or another unit of length"
        )
    return jnp.concatenate([turned, shift[:, :, None]], axis=2)


def linear_blend_skinning(
    vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike
) -> Float[Array, "vertices 3"]:
    """Return ``p'_i = sum_j w_ij T_j p_i`` (thesis chapter 3).

    Affine transformations are blended as matrices, so the blend of two rotations shrinks: a twist
    of 180 degrees collapses the middle. `dual_quaternion_skinning` does not shrink. This is a
    pure function of arrays: use jit, vmap over poses, and grad or jvp in all arguments.

    **Arguments**

    - vertices: (vertices, 3).
    - weights: (vertices, controls), each row with sum one.
    - transforms: (controls, 3, 4), the matrix and the shift of each control.

    **Returns** (vertices, 3).

    **Raises** InputError: shapes that do not fit together; a row of weights whose sum is not one;
    values that are not finite. Shapes are checked even while JAX traces, values only when they are
    known.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> moves = jd.rigid_transforms(np.zeros((2, 3)), [[0, 0, 0], [0, 4, 0]], np.zeros((2, 3)))
        >>> jd.linear_blend_skinning([[1.0, 0.0, 0.0]], [[0.75, 0.25]], moves).tolist()
        [[1.0, 1.0, 0.0]]
    """
    vertices, weights, transforms = _checked_skin(vertices, weights, transforms)
    blend = jnp.einsum("nm,mij->nij", weights, transforms, precision="highest")
    return _apply(blend[:, :, :3], blend[:, :, 3], vertices)


def dual_quaternion_skinning(
    vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike
) -> Float[Array, "vertices 3"]:
    """Blend rigid transformations as unit dual quaternions.

    The blend of rigid motions is a rigid motion, so nothing shrinks. A rotation has two quaternions
    of opposite sign. For each vertex, the one nearer to the control of largest weight is used,
    which takes the shorter way round. If two controls differ by exactly 180 degrees, neither way is
    shorter, and the result jumps there; everywhere else it is smooth. Use it with jit, vmap, grad
    and jvp, like `linear_blend_skinning`.

    Kavan, Collins, Zara and O'Sullivan, "Geometric skinning with approximate dual quaternion
    blending" (2008), doi:10.1145/1409625.1409627.

    **Arguments**

    - vertices: (vertices, 3).
    - weights: (vertices, controls), 0 or more, each row with sum one.
    - transforms: (controls, 3, 4), rigid: the rotation and the shift of each control.

    **Returns** (vertices, 3).

    **Raises** InputError as `linear_blend_skinning`; also for a negative weight and a matrix
    that is not a rotation.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> zero = np.zeros((2, 3))
        >>> moves = jd.rigid_transforms([[0, 0, 0], [0, 0, np.pi / 2]], zero, zero)
        >>> point = jd.dual_quaternion_skinning([[1.0, 0.0, 0.0]], [[0.5, 0.5]], moves)
        >>> bool(abs(np.linalg.norm(point) - 1) < 1e-6)
        True
    """
    vertices, weights, transforms = _checked_skin(vertices, weights, transforms)
    _check_blendable(weights, transforms)
    real = quaternions_from_matrices(transforms[:, :, :3])
    shift = jnp.concatenate([jnp.zeros_like(real[:, :1]), transforms[:, :, 3]], axis=1)
    dual = 0.5 * quaternion_product(shift, real)
    # q and -q are the same rotation. Take the sign nearer to the control of largest weight.
    nearness = jnp.matmul(real, real.T, precision="highest")
    side = jnp.where(nearness < 0.0, -1.0, 1.0).astype(real.dtype)
    signed = weights * side[jnp.argmax(weights, axis=1)]
    real, dual = (jnp.matmul(signed, q, precision="highest") for q in (real, dual))
    length = jnp.linalg.norm(real, axis=1, keepdims=True)
    real, dual = real / length, dual / length
    conjugate = real * jnp.asarray([1.0, -1.0, -1.0, -1.0], real.dtype)[None]
    return _apply(
        matrices_from_quaternions(real), 2.0 * quaternion_product(dual, conjugate)[:, 1:], vertices
    )


def _apply(matrices, shift, vertices) -> Float[Array, "vertices 3"]:
    return jnp.einsum("nij,nj->ni", matrices, vertices, precision="highest") + shift


# How far the sum of a row of weights may be from one, and R^T R of a rigid matrix from I. This is
# the error that single precision and text files with six digits leave.
_ALLOWANCE = 1e-5


def _checked_skin(vertices, weights, transforms) -> tuple[Array, Array, Array]:
    dtype = jnp.result_type(float)
    vertices = read_rows("vertices", vertices, dtype)
    weights = as_array(weights, dtype, "weights")
    if weights.ndim != 2 or len(weights) != len(vertices):
        raise InputError(f"weights have shape {weights.shape}: give ({len(vertices)}, controls)")
    weights = read_jax_positions("weights", weights, weights.shape, dtype)
    if is_concrete(weights):
        total = np.asarray(weights).sum(axis=1)
        bad = np.flatnonzero(np.abs(total - 1.0) > _ALLOWANCE)
        if bad.size:
            raise InputError(
                f"the weights of vertex {bad[0]} sum to {total[bad[0]]:.6g}, not to 1: divide each "
                "row by its sum"
            )
    shape = (weights.shape[1], 3, 4)
    return vertices, weights, read_jax_positions("transforms", transforms, shape, dtype, "control")


def _check_blendable(weights: Array, transforms: Array) -> None:
    if is_concrete(weights):
        low = np.asarray(weights).min(axis=1, initial=0.0)
        bad = np.flatnonzero(low < -_ALLOWANCE)
        if bad.size:
            raise InputError(
                f"a weight of vertex {bad[0]} is {low[bad[0]]:.6g}: dual quaternions blend only "
                "between motions; give weights of 0 or more, or use linear_blend_skinning"
            )
    if is_concrete(transforms):
        matrices = np.asarray(transforms)[:, :, :3]
        gap = np.abs(np.swapaxes(matrices, 1, 2) @ matrices - np.eye(3)).max(axis=(1, 2))
        bad = np.flatnonzero((gap > _ALLOWANCE) | (np.linalg.det(matrices) < 0))
        if bad.size:
            raise InputError(
                f"the matrix of control {bad[0]} is not a rotation (it stretches, shears or "
                "reflects): give rigid motions, or use linear_blend_skinning"
            )
