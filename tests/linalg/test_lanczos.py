"""The lowest mode of a pencil of matrices, against dense solvers."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxdeform._linalg import lanczos
from jaxdeform._linalg.lanczos import lowest_mode


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("steps", [1, 2, 5, 17, 64])
def test_lowest_of_a_tridiagonal_matrix(steps, dtype):
    rng = np.random.default_rng(steps)
    a = rng.normal(size=64).astype(dtype)
    b = np.abs(rng.normal(size=64)).astype(dtype)
    value, vector = lanczos._lowest(jnp.asarray(a), jnp.asarray(b), jnp.int32(steps))
    values, vectors = scipy.linalg.eigh_tridiagonal(a[:steps], b[: steps - 1])
    near = 1e-12 if dtype == np.float64 else 1e-5  # what lanczos.py promises; rounding
    assert abs(value - values[0]) < near
    assert abs(abs(vector[:steps] @ vectors[:, 0]) - 1) < near
    assert not np.any(vector[steps:])


@pytest.mark.parametrize("n", [1, 2, 3])
def test_fewer_unknowns_than_steps(n):
    for shift in (-0.3, 0.2):
        assert np.sign(lowest(n, 64, shift)[0]) == np.sign(shift)


def test_nan_ends():
    nothing = lambda x: jnp.full_like(x, jnp.nan)  # noqa: E731
    value, x = lowest_mode(nothing, lambda x: x, jnp.ones((3, 4)), 64)
    assert not value < 0
    assert not np.any(np.asarray(x))


def lowest(n: int, steps: int, shift: float):
    """Return what some steps of Lanczos say of random matrices H and M, and the truth."""
    rng = np.random.default_rng(n)
    spread = np.linspace(0.0, 2.0, 3 * n)
    spread[0] = shift
    half = rng.standard_normal((3 * n, 3 * n)) + 4.0 * np.sqrt(n) * np.eye(3 * n)
    mass = half @ half.T
    basis = np.linalg.qr(rng.standard_normal((3 * n, 3 * n)))[0]
    hessian = half @ (basis * spread) @ basis.T @ half.T
    inverse = np.linalg.inv(mass)
    shaped = lambda a: lambda x: (jnp.asarray(a) @ x.ravel()).reshape(x.shape)  # noqa: E731
    start = jnp.asarray(rng.standard_normal((3, n)))
    value, x = lowest_mode(shaped(hessian), shaped(inverse), start, steps)
    return float(value), np.asarray(x).ravel(), hessian, mass


def test_lanczos_finds_a_negative_mode():
    value, x, hessian, mass = lowest(40, 40, -0.5)
    assert -0.5 <= value < 0.0
    np.testing.assert_allclose(x @ hessian @ x, value, rtol=1e-6)
    np.testing.assert_allclose(x @ mass @ x, 1.0, rtol=1e-6)


@pytest.mark.parametrize("steps", [1, 2, 5, 12])
def test_lanczos_never_promises_too_much(steps):
    """Its value is that of a vector, so never below the lowest one."""
    for shift in (-0.3, 0.2):
        assert lowest(30, steps, shift)[0] >= min(shift, 0.0) - 1e-9
    assert not lowest(30, steps, 0.2)[1].any()
