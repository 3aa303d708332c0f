"""The energy of Eq. 4.4, cell by cell.

E(p', T) = tr(p'^T A p') - 2 sum_k tr(T_k C_k) + sum_k tr(T_k B_k T_k^T)
           + sum_k lambda_k |T_k^T T_k - I|^2,                         C = K p'
"""

from jaxtyping import Array, Float

from jaxdeform._linalg.xla import total


def local_energy(
    transforms: Float[Array, "3 3 v"],
    c: Float[Array, "3 3 v"],
    principal_moments: Float[Array, "3 v"],
    rigidity: Float[Array, "v"],
    batch: int | None = None,
) -> Float[Array, "*batch"]:
    """Return the sum over all cells of ``lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C)``.

    With a batch, one sum for each of its members.
    """
    gram = [[_dot(transforms[:, i], transforms[:, j]) for j in range(i + 1)] for i in range(3)]
    stretch = sum((gram[i][i] - 1.0) ** 2 for i in range(3))
    shear = sum(gram[i][j] ** 2 for i in range(3) for j in range(i))
    data = sum(
        principal_moments[i] * gram[i][i] - 2.0 * _dot(transforms[:, i], c[i]) for i in range(3)
    )
    return total(rigidity * (stretch + 2.0 * shear) + data, batch)


def _dot(u: Float[Array, "3 v"], v: Float[Array, "3 v"]) -> Float[Array, "v"]:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
