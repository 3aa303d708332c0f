"""Rotations: the polar factor, rotation vectors and quaternions."""

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdeform._linalg.known_value import with_derivative_of
from jaxdeform._linalg.small_matrices import (
    Grid,
    Matrices,
    Scalars,
    as_grid,
    cross,
    from_grid,
    identity,
    inner,
    product,
    transpose,
    where,
)
from jaxdeform._linalg.subset import SMALL, on_few


def polar_rotation(c: Matrices) -> Matrices:
    """Return the proper rotations R (det +1) that maximise tr(R C), cell by cell.

    If ``C = U S V^T``, then ``R = V U^T``. If that is a reflection, the direction of the smallest
    singular value changes sign. The rotation comes in closed form from the root of a quartic (FOAM,
    Markley, "Attitude determination using vector observations: a fast optimal matrix algorithm",
    1993), which keeps full precision on flat cells too. Where R is not unique, or nearly so, the
    SVD is used. 51,200 cells take 2.5 ms; a Jacobi SVD by components takes 10 ms, LAPACK's 130 ms.
    """
    return from_grid(polar_rotation_of_grid(as_grid(c)))


def polar_rotation_of_grid(c: Grid) -> Grid:
    # Scale the entries to the order of 1, because the products square and cube them.
    size = reduce(jnp.maximum, [jnp.abs(v) for row in c for v in row])
    scale = jnp.where(size > 0, size, 1.0)
    c = [[v / scale for v in row] for row in c]
    rotation, certain = _markley(c)
    n = size.shape[0]
    return on_few(_svd_rotation, ~certain, n if n <= SMALL else n // 64, rotation, c)


def _markley(c: Grid) -> tuple[Grid, Bool[Array, "cells"]]:
    """Return the rotations, and for which cells they are exact.

    The largest root of ``(x^2 - |C|^2)^2 - 4 |cof C|^2 - 8 x det C`` is x = s1 + s2 + s3, the sum
    of the singular values, where s3 takes the sign of det C. Newton's method descends to it from an
    upper bound. The error of R is the error of the root divided by
    ``zeta = (s1 + s2) (s2 + s3) (s3 + s1)``: 1e-15 to 1e-11 where zeta > 1e-4 x^3.
    """
    a = transpose(c)
    eps = jnp.finfo(a[0][0].dtype).eps
    cofactor = [cross(a[1], a[2]), cross(a[2], a[0]), cross(a[0], a[1])]
    square = jnp.asarray(sum(inner(row, row) for row in a))
    det = inner(a[0], cofactor[0])
    area = sum(inner(row, row) for row in cofactor)

    def newton(_, state):
        x, _ = state
        rise = x * x - square
        slope = 4.0 * x * rise - 8.0 * det
        move = (rise * rise - 4.0 * area - 8.0 * det * x) / jnp.where(slope > 0, slope, 1.0)
        return x - move, jnp.abs(move)

    bound = jnp.sqrt(square + 2.0 * jnp.sqrt(3.0 * area))
    # Take three steps in one pass over the cells. Without the loop, the compiler would repeat them
    # for each of the nine entries that follow.
    thrice = lambda _, state: reduce(lambda s, k: newton(k, s), range(3), state)  # noqa: E731
    x, move = jax.lax.fori_loop(0, 2, thrice, (bound, bound))
    kappa = 0.5 * (x * x - square)
    zeta = kappa * x - det
    gram = product(transpose(a), a)
    cubic = product(a, gram)
    scale = jnp.where(zeta > 0, zeta, 1.0)
    rotation = [
        [((kappa + square) * a[i][j] + x * cofactor[i][j] - cubic[i][j]) / scale for j in range(3)]
        for i in range(3)
    ]
    certain = (zeta > (1e-4 + 1e5 * eps) * x**3) & (move <= jnp.sqrt(eps) * x)
    # A cell without extent (an unreferenced vertex) does not rotate.
    point = square == 0
    return where(point, identity(x), rotation), certain | point


def _svd_rotation(rotation: Grid, c: Grid) -> Grid:
    """Return the rotations by LAPACK's SVD, which decides where several are equally good."""
    del rotation
    u, _, vt = jnp.linalg.svd(jnp.moveaxis(from_grid(c), -1, 0))
    sign = jnp.sign(jnp.linalg.det(u) * jnp.linalg.det(vt))
    last = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign], axis=-1)
    return as_grid(
        jnp.moveaxis(jnp.einsum("kij,ki,kli->kjl", vt, last, u, precision="highest"), 0, -1)
    )


@jax.custom_jvp
def rotation_with_derivative(rotation: Matrices, c: Matrices) -> Matrices:
    del c
    return rotation


@rotation_with_derivative.defjvp
def _rotation_jvp(primals, tangents):
    """``dR = R [w]x`` with ``(tr(M) I - M) w = axial(N - N^T)``, M = C R, N = R^T dC^T."""
    rotation, c = primals
    fixed = jax.lax.stop_gradient((rotation, c))

    def turned(rotation: Matrices, c: Matrices) -> Matrices:
        lean = _axial(product(transpose(as_grid(rotation)), transpose(as_grid(c))))
        return rotation + from_grid(_turn(*fixed, lean))

    rotation = rotation_with_derivative(rotation, c)  # so that the rule itself has derivatives
    # A turn of size 0 that has the derivatives of R by itself: reverse mode through a scan takes R
    # for a constant (JAX drops the rule of what it knows), and a second derivative must not.
    rotation = with_derivative_of(turned, rotation, rotation, c)
    lean = _axial(product(transpose(as_grid(rotation)), transpose(as_grid(tangents[1]))))
    return rotation, from_grid(_turn(rotation, c, lean))


def _axial(n: Grid) -> list[Scalars]:
    return [n[2][1] - n[1][2], n[0][2] - n[2][0], n[1][0] - n[0][1]]


def _turn(rotation: Matrices, c: Matrices, lean: list[Scalars]) -> Grid:
    """Return ``R [w]x`` with ``(tr(M) I - M) w = lean``, M = C R."""
    r = as_grid(rotation)
    m = product(as_grid(c), r)
    trace = m[0][0] + m[1][1] + m[2][2]
    # Without unit: the cube of a length squared leaves the range of float32 at 1e6 and 1e-6.
    size = jnp.abs(trace)
    inverse = 1.0 / jnp.where(size > 0, size, 1.0)
    s = [
        [((trace if i == j else 0.0) - 0.5 * (m[i][j] + m[j][i])) * inverse for j in range(3)]
        for i in range(3)
    ]
    cofactor = [cross(s[1], s[2]), cross(s[2], s[0]), cross(s[0], s[1])]
    det = inner(s[0], cofactor[0])
    # Where no rotation is unique, the derivative is 0.
    det = jnp.where(jnp.abs(det) > jnp.finfo(c.dtype).eps, det, jnp.inf)
    w = [sum(cofactor[k][i] * lean[k] for k in range(3)) * inverse / det for i in range(3)]
    zero = jnp.zeros_like(trace)
    return product(r, [[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def quaternions_from_matrices(matrices: Float[Array, "rows 3 3"]) -> Float[Array, "rows 4"]:
    """Return the quaternions (w, x, y, z) of rotation matrices, with either sign.

    ``4 q q^T`` is linear in the matrix. Its row with the largest diagonal entry is q times a
    number of size 1 or more. It is therefore smooth everywhere, even at 0 and 180 degrees.
    """
    (a, b, c), (d, e, f), (g, h, i) = jnp.moveaxis(matrices, 0, -1)
    outer = jnp.stack(
        [
            jnp.stack([1 + a + e + i, h - f, c - g, d - b], axis=1),
            jnp.stack([h - f, 1 + a - e - i, b + d, c + g], axis=1),
            jnp.stack([c - g, b + d, 1 - a + e - i, f + h], axis=1),
            jnp.stack([d - b, c + g, f + h, 1 - a - e + i], axis=1),
        ],
        axis=1,
    )
    largest = jnp.argmax(jnp.diagonal(outer, axis1=1, axis2=2), axis=1)
    row = jnp.take_along_axis(outer, largest[:, None, None], axis=1)[:, 0]
    return row / jnp.linalg.norm(row, axis=1, keepdims=True)


def matrices_from_quaternions(q: Float[Array, "rows 4"]) -> Float[Array, "rows 3 3"]:
    w, x, y, z = q.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def quaternion_product(
    p: Float[Array, "rows 4"], q: Float[Array, "rows 4"]
) -> Float[Array, "rows 4"]:
    (a, b, c, d), (w, x, y, z) = p.T, q.T
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=1,
    )


def rotation_matrices(
    vectors: Float[Array, "rotations 3"] | Float[np.ndarray, "rotations 3"],
) -> Float[Array, "rotations 3 3"] | Float[np.ndarray, "rotations 3 3"]:
    """Return Rodrigues' rotation of each vector: its direction is the axis, its length the angle.

    Series near the zero angle, so that derivatives exist there. NumPy's arrays give NumPy's,
    JAX's give JAX's.
    """
    xp = jnp if isinstance(vectors, jax.Array) else np
    square = xp.sum(vectors**2, axis=1)
    small = square < 1e-8
    safe = xp.where(small, 1.0, square)
    angle = xp.sqrt(safe)
    sine = xp.where(small, 1.0 - square / 6.0, xp.sin(angle) / angle)
    # 1 - cos by the half angle, which loses no digits.
    cosine = xp.where(small, 0.5 - square / 24.0, 2.0 * xp.sin(angle / 2.0) ** 2 / safe)
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    zero = xp.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    cross = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    eye = xp.eye(3, dtype=vectors.dtype)[None]
    return eye + sine[:, None, None] * cross + cosine[:, None, None] * (cross @ cross)
