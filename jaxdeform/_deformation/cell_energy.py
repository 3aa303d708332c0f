"""The energy of a cell (Eq. 4.2), its gradient and Hessian.

The sum over all cells is Eq. 4.4: E(p', T) = tr(p'^T A p') + sum_k phi_k(T_k),

    phi(T) = lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C),      C = K p'.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jaxdeform._linalg.block_factor import Blocks
from jaxdeform._linalg.small_matrices import (
    Grid,
    Matrices,
    Scalars,
    Vectors,
    inner,
    minus_identity,
    product,
    product_of_arrays,
    transpose,
    transpose_of_array,
)


def cell_energy(t, c, b, lam):
    """Eq. 4.2 for one cell, with matrices (3, 3): the form for jaxopt and the thesis's descent."""
    strain = jnp.matmul(t.T, t, precision="highest") - jnp.eye(3, dtype=t.dtype)
    return lam * jnp.sum(strain**2) + jnp.sum(t**2 * b[None, :]) - 2.0 * jnp.sum(t * c.T)


def cell_energies(t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Scalars:
    """Eq. 4.2 for all cells (the last axis): ``lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C)``."""
    gram = [[inner(t[:, i], t[:, j]) for j in range(i + 1)] for i in range(3)]
    stretch = sum((gram[i][i] - 1.0) ** 2 for i in range(3))
    shear = sum(gram[i][j] ** 2 for i in range(3) for j in range(i))
    data = sum(b[i] * gram[i][i] - 2.0 * inner(t[:, i], c[i]) for i in range(3))
    return rigidity * (stretch + 2.0 * shear) + data


def cell_sizes(b: Vectors, rigidity: Scalars) -> Scalars:
    """Return the size of the coefficients of each cell; 1 where all are 0."""
    size = rigidity + jnp.max(jnp.abs(b), axis=0)
    return jnp.where(size > 0, size, 1.0)


def half_gradient(x: Grid, m: Grid, b: list[Array], lam: Array) -> Grid:
    """Half the gradient of phi at X: ``2 lambda X (X^T X - I) + X B - M^T`` (Eq. 4.3)."""
    gram = product(transpose(x), x)
    middle = [
        [
            2.0 * lam * (gram[i][j] - 1.0) + b[i] if i == j else 2.0 * lam * gram[i][j]
            for j in range(3)
        ]
        for i in range(3)
    ]
    g = product(x, middle)
    return [[g[i][j] - m[j][i] for j in range(3)] for i in range(3)]


def half_hessian(t: Matrices, b: Vectors, lam: Scalars) -> Blocks:
    """Half the Hessian of phi at T, as a matrix: what `half_hessian_product` multiplies with.

    Its blocks are those of the rows of T.
    """
    unit = jnp.eye(3, dtype=t.dtype)[..., None]
    gram = product_of_arrays(transpose_of_array(t), t)
    twice = 2.0 * lam[None, None]

    def block(i: int, k: int) -> Matrices:
        strain = inner(t[i], t[k])[None, None] * unit + t[k, :, None] * t[i, None]
        if i != k:
            return twice * strain
        return twice * (strain + gram - unit) + unit * b[None]

    return (
        (block(0, 0),),
        (block(1, 0), block(1, 1)),
        (block(2, 0), block(2, 1), block(2, 2)),
    )


def half_hessian_product(x: Grid, b: list[Array], lam: Array, v: Grid) -> Grid:
    """Half the Hessian of phi at X times a direction V.

    ``2 lambda (V (X^T X - I) + X X^T V + X V^T X) + V B``.
    """
    gram = minus_identity(product(transpose(x), x))
    terms = (
        product(v, gram),
        product(product(x, transpose(x)), v),
        product(x, product(transpose(v), x)),
    )
    return [
        [2.0 * lam * sum(term[i][j] for term in terms) + v[i][j] * b[j] for j in range(3)]
        for i in range(3)
    ]
