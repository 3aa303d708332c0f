"""Smooth fields: the prior, the step and the intervals by themselves, and a field recovered."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import EXACT, ends

import jaxdeform as jd
from jaxdeform._estimation.bounded_gauss_newton import Evaluation
from jaxdeform._estimation.field import _prior, _Solve, _spread, _stages, _WithPrior
from jaxdeform._mesh.laplacian import graph_laplacian, lifted_weights


def test_the_prior_is_the_laplacian(bar, bar_problem):
    prior = _prior(bar_problem)
    theta = np.random.default_rng(0).standard_normal(bar.n_vertices)
    laplacian = graph_laplacian(
        bar.edges, lifted_weights(jd.cotangent_weights(bar)), bar.n_vertices
    )
    found = np.sum(np.asarray(prior.differences(jnp.asarray(theta))) ** 2)
    np.testing.assert_allclose(found, theta @ laplacian @ theta, rtol=EXACT)
    assert np.abs(prior.differences(jnp.ones(bar.n_vertices))).max() == 0.0


@pytest.mark.parametrize(
    ("smoothness", "stages"),
    [
        (1e-5, [1e-2, 1e-3, 1e-4, 1e-5]),
        (3e-4, [1e-2, 1e-3, 3e-4]),
        (1e-2, [1e-2]),
        (5.0, [5.0]),
    ],
)
def test_the_prior_weakens_in_stages(smoothness, stages):
    np.testing.assert_allclose(_stages(smoothness), stages, rtol=EXACT)


def test_the_prior_never_rewards_differences():
    """A sliver: the cotangent opposite its long edge is negative."""
    sliver = jd.Mesh([[0, 0, 0], [1, 0, 0], [0.5, 0.05, 0]], [[0, 1, 2]])
    assert jd.cotangent_weights(sliver).min() < 0
    assert lifted_weights(jd.cotangent_weights(sliver)).min() > 0


@pytest.fixture(scope="module")
def small():
    """A linear model of 9 unknowns with the prior below it, and its matrix."""
    problem = jd.precompute(jd.shapes.square(), [0, 1, 2, 6, 7, 8])
    prior = _prior(problem)
    data = jnp.asarray(np.random.default_rng(0).standard_normal((12, 9)))
    weight = jnp.asarray(2.0)
    shape = jax.ShapeDtypeStruct((9,), jnp.float64)
    operator = lx.FunctionLinearOperator(lambda x: data @ x, shape)
    jacobian = _WithPrior(operator, prior, weight)
    rows = jax.vmap(jacobian.mv, out_axes=-1)(jnp.eye(9))
    return jacobian, np.concatenate(rows), _Solve(prior.factor, weight)


def test_the_step_solves_the_normal_equations(small):
    """To 1e-2 of the right-hand side, as conjugate gradients are told."""
    jacobian, matrix, solve = small
    draw = np.random.default_rng(1)
    residual = jax.eval_shape(jacobian.mv, jnp.zeros(9))
    residual = jax.tree.map(lambda leaf: jnp.asarray(draw.standard_normal(leaf.shape)), residual)
    operator = lx.FunctionLinearOperator(jacobian.mv, jax.ShapeDtypeStruct((9,), jnp.float64))
    step = np.asarray(eqx.filter_jit(solve)(operator, residual))
    right = -matrix.T @ np.concatenate(residual)
    assert np.linalg.norm(matrix.T @ matrix @ step - right) <= 0.01 * np.linalg.norm(right)


def test_the_spread_is_that_of_the_inverse(small):
    """Of 32 samples: each deviation is good to 12 %."""
    jacobian, matrix, solve = small
    residual = jacobian.mv(jnp.zeros(9))
    spread = np.asarray(_spread(Evaluation(jnp.zeros(9), residual, jacobian), solve))
    exact = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)))
    np.testing.assert_allclose(spread, exact, rtol=0.4)  # three standard errors
    assert abs(np.mean((spread / exact) ** 2) - 1.0) < 0.25


@pytest.mark.slow
def test_a_smooth_field_is_recovered_from_three_poses(bar, bar_problem):
    points = bar.vertices[bar_problem.handles]
    up = np.where(points[:, 1:2] > 75, 30.0, 0.0) * np.array([[0.0, 1.0, 0.0]])
    targets = np.stack([jd.bend(points, 90.0), jd.twist(points, 90.0), points + up])
    true = 0.01 * 1000.0 ** (bar.vertices[:, 1] / 151.0)
    poses = np.stack([np.asarray(jd.deform(bar_problem, t, true).vertices) for t in targets])
    assert len(ends(bar)) == len(points)
    fit = jd.estimate_rigidity_field(bar_problem, poses, smoothness=1e-9)
    assert np.median(np.abs(fit.field / true - 1)) < 0.1
