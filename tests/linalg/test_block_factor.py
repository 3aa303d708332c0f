import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxdeform._deformation.cell_energy import half_hessian
from jaxdeform._linalg.block_factor import BlockFactor


def blocks(matrix):
    return tuple(
        tuple(matrix[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] for j in range(i + 1)) for i in range(3)
    )


def solve(matrix, right, floor):
    factor = BlockFactor.of(blocks(jnp.asarray(matrix)), jnp.full(matrix.shape[-1], floor))
    return np.asarray(factor.solve(jnp.asarray(right).reshape(3, 3, -1))).reshape(9, -1)


@pytest.mark.parametrize("definite", [True, False], ids=["definite", "indefinite"])
def test_it_solves_as_lapack_does(definite):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(9, 9, 50))
    if definite:
        matrix = np.einsum("ikn,jkn->ijn", root, root) + np.eye(9)[..., None]
    else:
        matrix = root + root.transpose(1, 0, 2)
    right = rng.normal(size=(9, 50))
    expected = np.linalg.solve(matrix.transpose(2, 0, 1), right.T[..., None])[..., 0].T
    # Without pivoting; the worst of these has 1e4 times the rounding error of LAPACK.
    np.testing.assert_allclose(solve(matrix, right, 1e-16), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("axis", range(9))
def test_a_direction_without_stiffness_gets_the_floor(axis):
    stiffness = np.arange(1.0, 10.0)
    stiffness[axis] = 0.0
    out = solve(np.diag(stiffness)[..., None], np.ones((9, 1)), 1e-3)
    stiffness[axis] = 1e-3
    np.testing.assert_allclose(out[:, 0], 1.0 / stiffness, rtol=1e-14)


@pytest.mark.parametrize("rigidity", [1e4, 1e8, 1e12])
@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_a_stiff_cell_loses_no_more_digits_than_in_lapack(rigidity, flat):
    """It turns at the price of B alone, which is a difference of numbers as large as lambda."""
    rng = np.random.default_rng(0)
    turned = Rotation.random(200, rng=0).as_matrix()
    b = rng.uniform(0.1, 2.0, (3, 200))
    b[2] = 0.0 if flat else b[2]
    spin = rng.normal(size=(200, 3, 3))
    answer = np.moveaxis(turned @ (spin - spin.transpose(0, 2, 1)), 0, -1)  # a turn: no strain
    scale = rigidity + b.max(axis=0)
    lower = half_hessian(
        jnp.asarray(np.moveaxis(turned, 0, -1)),
        jnp.asarray(b / scale),
        jnp.asarray(rigidity / scale),
    )
    right = answer * (b / scale)[None]
    found = BlockFactor.of(lower, jnp.full(200, 2e-16)).solve(jnp.asarray(right))
    whole = np.zeros((9, 9, 200))
    for i in range(3):
        for j in range(i + 1):
            block = np.asarray(lower[i][j])
            whole[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = block
            whole[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = block.transpose(1, 0, 2)
    peer = np.linalg.solve(whole.transpose(2, 0, 1), right.reshape(9, -1).T[..., None])[..., 0].T

    def error(x):
        return np.abs(np.asarray(x).reshape(9, -1) - answer.reshape(9, -1)).max()

    assert error(found) < 10 * error(peer)
