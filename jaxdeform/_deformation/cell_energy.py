"""The energy of a cell (Eq. 4.2), its gradient and Hessian.

The sum over all cells is Eq. 4.4: E(p', T) = tr(p'^T A p') + sum_k phi_k(T_k),

    phi(T) = lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C),      C = K p'.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jaxdeform._linalg.small_matrices import (
    Grid,
    Matrices,
    Scalars,
    Vectors,
    minus_identity,
    product,
    transpose,
)


def cell_energy(t, c, b, lam):
    """Eq. 4.2 for one cell, with matrices (3, 3): the form for jaxopt and the thesis's descent."""
    strain = jnp.matmul(t.T, t, precision="highest") - jnp.eye(3, dtype=t.dtype)
    return lam * jnp.sum(strain**2) + jnp.sum(t**2 * b[None, :]) - 2.0 * jnp.sum(t * c.T)


def cell_energies(t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Scalars:
    """Eq. 4.2 for all cells (the last axis): ``lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C)``."""
    gram = [[_dot(t[:, i], t[:, j]) for j in range(i + 1)] for i in range(3)]
    stretch = sum((gram[i][i] - 1.0) ** 2 for i in range(3))
    shear = sum(gram[i][j] ** 2 for i in range(3) for j in range(i))
    data = sum(b[i] * gram[i][i] - 2.0 * _dot(t[:, i], c[i]) for i in range(3))
    return rigidity * (stretch + 2.0 * shear) + data


def _dot(u: Vectors, v: Vectors) -> Scalars:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


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


def half_hessian(x: Grid, b: list[Array], lam: Array) -> list[list[Array]]:
    """Half the Hessian of phi at X as a full 9x9 matrix. (Only its lower half is used.)"""
    gram, outer = product(transpose(x), x), product(x, transpose(x))
    rows: list[list[Array]] = []
    for i in range(3):
        for j in range(3):
            row = []
            for k in range(3):
                for l in range(3):  # noqa: E741
                    value = x[i][l] * x[k][j]
                    if l == j:
                        value = value + outer[i][k]
                    if i == k:
                        value = value + gram[l][j]
                    if (i, j) == (k, l):
                        row.append(2.0 * lam * (value - 1.0) + b[j])
                    else:
                        row.append(2.0 * lam * value)
            rows.append(row)
    return rows


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
