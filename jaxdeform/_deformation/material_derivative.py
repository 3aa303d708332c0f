"""The derivative of the local step of the material: of its minimum, not of its iterations."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdeform._deformation.cell_energy import (
    cell_sizes,
    half_gradient,
    half_hessian,
    half_hessian_product,
)
from jaxdeform._linalg.block_factor import BlockFactor
from jaxdeform._linalg.known_value import with_derivative_of
from jaxdeform._linalg.small_matrices import (
    Grid,
    Matrices,
    Scalars,
    Vectors,
    as_grid,
    from_grid,
    minus_identity,
    product,
    transpose,
)
from jaxdeform._linalg.xla import without_fusion


@jax.custom_jvp
def material_with_derivative(t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
    """Return t, known to minimise Eq. 4.2 for C, b and lambda, with the derivatives of that."""
    del c, b, rigidity
    return t


@material_with_derivative.defjvp
def _material_with_derivative_jvp(primals, tangents):
    """Differentiate the condition grad phi(T) = 0 instead of the iterations.

    ``H dT = dC^T - T dB - 2 (T T^T T - T) dlambda`` with H half the Hessian. A prototype that
    differentiated the iterations took 40 s to compile.
    """
    hessian = _Hessian.at(primals[0], *primals[2:])

    def newton(t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        slope = from_grid(half_gradient(as_grid(t), as_grid(c), list(b), rigidity))
        return t - hessian.solve(hessian.of, slope)

    t, c, b, rigidity = primals
    t = material_with_derivative(t, c, b, rigidity)  # so that this rule has derivatives too
    # A Newton step of size 0. It has the derivatives of T by itself: reverse mode through a scan
    # takes t for a constant (JAX drops the rule of what it knows), and a second derivative must
    # not.
    t = with_derivative_of(newton, t, t, c, b, rigidity)
    _, dc, db, dlam = tangents
    tg = as_grid(t)
    excess = product(tg, minus_identity(product(transpose(tg), tg)))
    right = [
        [dc[j, i] - tg[i][j] * db[j] - 2.0 * excess[i][j] * dlam for j in range(3)]
        for i in range(3)
    ]
    return t, hessian.solve((tg, list(b), rigidity), from_grid(right))


class _Hessian(NamedTuple):
    """Half the Hessian of phi in every cell, and its factor.

    As a linear solve of its own, so that derivatives of second order solve again instead of
    differentiating the elimination. H is factored outside of it: what solves for many right-hand
    sides, as conjugate gradients do, factors once.
    """

    of: tuple[Grid, list[Array], Array]
    """T, b and lambda where it was factored, as constants."""
    factor: BlockFactor
    scale: Scalars
    """What H was divided by before."""

    @staticmethod
    def at(t: Matrices, b: Vectors, rigidity: Scalars) -> "_Hessian":
        """Factor H; directions without stiffness get a floor."""
        t, b, rigidity = jax.lax.stop_gradient((t, b, rigidity))
        scale = cell_sizes(b, rigidity)
        floor = jnp.full_like(scale, jnp.finfo(t.dtype).eps)
        factor = BlockFactor.of(half_hessian(t, b / scale[None], rigidity / scale), floor)
        return _Hessian((as_grid(t), list(b), rigidity), factor, scale)

    def solve(self, of: tuple[Grid, list[Array], Array], right: Matrices) -> Matrices:
        """Solve H dT = right, with the derivatives of H where it is ``of`` T, b and lambda."""

        def apply(v: Matrices) -> Matrices:
            return from_grid(half_hessian_product(*of, as_grid(v)))

        def solve(_, r: Matrices) -> Matrices:
            right = r / self.scale[None, None]
            # Otherwise XLA solves again for each input that reads it: 3.4 instead of 1.5 ms.
            return without_fusion(jnp.any(self.scale > 0), r, self.factor.solve, right)

        return jax.lax.custom_linear_solve(apply, right, solve, symmetric=True)
