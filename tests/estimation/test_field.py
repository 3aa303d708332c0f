"""Smooth fields: prior, step, evidence and intervals on linear problems, and fields recovered."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import EXACT, ends, noisy, without_buckets
from scipy.stats import multivariate_normal

import jaxdeform as jd
from jaxdeform._estimation.evidence import (
    Evidence,
    Patterns,
    deviations,
    find_patterns,
    most_probable,
    patch_deviations,
    with_noise,
)
from jaxdeform._estimation.field_prior import FLAT, Prior, Solve, WithPrior
from jaxdeform._estimation.field_search import _stages
from jaxdeform._mesh.laplacian import graph_laplacian, lifted_weights

# ---------------------------------------------------------------- the prior


def exact(mesh, handles):
    """Return a problem whose arrays are as long as the mesh."""
    with pytest.MonkeyPatch.context() as patch:
        without_buckets(patch)
        return jd.precompute(mesh, handles)


@pytest.fixture(scope="module")
def exact_problem(bar):
    return exact(bar, ends(bar))


def laplacian_of(mesh):
    weights = lifted_weights(jd.cotangent_weights(mesh))
    return graph_laplacian(mesh.edges, weights, mesh.n_vertices).toarray()


def test_the_prior_is_the_laplacian(bar, exact_problem):
    prior = Prior.of(exact_problem)
    theta = np.random.default_rng(0).standard_normal(bar.n_vertices)
    laplacian = laplacian_of(bar)
    found = np.sum(np.asarray(prior.differences(jnp.asarray(theta))) ** 2)
    np.testing.assert_allclose(found, theta @ laplacian @ theta, rtol=EXACT)
    assert np.abs(prior.differences(jnp.ones(bar.n_vertices))).max() == 0.0
    definite = laplacian + 0.01 * np.eye(bar.n_vertices)
    vectors = np.random.default_rng(1).standard_normal((bar.n_vertices, 3))
    np.testing.assert_allclose(
        prior.product(jnp.asarray(vectors)), definite @ vectors, atol=EXACT * 100
    )
    np.testing.assert_allclose(prior.variances(), np.diag(np.linalg.inv(definite)), rtol=1e-8)


def test_total_variation_near_a_field_has_the_slope_of_hubers_function(bar, exact_problem):
    """Squares up to FLAT, then straight: reweighted least squares ends where that is least."""
    random, h = np.random.default_rng(0), 1e-7
    near, direction = (random.standard_normal(bar.n_vertices) for _ in range(2))
    near[::2] *= 1e-3  # some differences of either kind
    near[1::3] = near[bar.edges[0, 0]]
    weights = lifted_weights(jd.cotangent_weights(bar))

    def huber(t):
        size = np.abs(t[bar.edges[:, 0]] - t[bar.edges[:, 1]])
        return weights @ np.where(size < FLAT, size**2, 2 * FLAT * size - FLAT**2)

    slope = (huber(near + h * direction) - huber(near - h * direction)) / (2 * h)
    prior = Prior.of(exact_problem, near)
    value = lambda t: prior.value(jnp.asarray(t))  # noqa: E731
    found = (value(near + direction) - value(near - direction)) / 2  # of a square: exact
    np.testing.assert_allclose(found, slope, rtol=1e-5)


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


# ---------------------------------------------------------------- a linear problem


@pytest.fixture(scope="module")
def small():
    """A linear model of 9 unknowns with the prior below it, and its matrix."""
    problem = exact(jd.shapes.square(), [0, 1, 2, 6, 7, 8])
    prior = Prior.of(problem)
    data = jnp.asarray(np.random.default_rng(0).standard_normal((12, 9)))
    weight = jnp.asarray(2.0)
    shape = jax.ShapeDtypeStruct((9,), jnp.float64)
    operator = lx.FunctionLinearOperator(lambda x: data @ x, shape)
    jacobian = WithPrior(operator, prior, weight)
    rows = jax.vmap(jacobian.mv, out_axes=-1)(jnp.eye(9))
    return jacobian, np.concatenate(rows), Solve(prior.factor, weight)


def test_the_step_solves_the_normal_equations(small):
    """To 3e-2 of the right-hand side, as conjugate gradients are told."""
    jacobian, matrix, solve = small
    draw = np.random.default_rng(1)
    residual = jax.eval_shape(jacobian.mv, jnp.zeros(9))
    residual = jax.tree.map(lambda leaf: jnp.asarray(draw.standard_normal(leaf.shape)), residual)
    operator = lx.FunctionLinearOperator(jacobian.mv, jax.ShapeDtypeStruct((9,), jnp.float64))
    step = np.asarray(eqx.filter_jit(solve)(operator, residual))
    right = -matrix.T @ np.concatenate(residual)
    assert np.linalg.norm(matrix.T @ matrix @ step - right) <= 0.03 * np.linalg.norm(right)


class Linear:
    """Poses of the bumpy bar that answer linearly to the field, and what dense algebra says."""

    def __init__(self, problem, draw, weight, noise):
        n = problem.n_vertices
        self.prior = Prior.of(problem)
        self.definite = laplacian_of(problem.mesh) + 0.01 * np.eye(n)
        # 10 vertices see the field through blurs, some clearly and some not at all.
        blurs = draw.standard_normal((30, n)) @ np.linalg.inv(self.definite)
        self.matrix = np.geomspace(1.0, 1e-4, 30)[:, None] * blurs
        self.covariance = noise**2 / weight * np.linalg.inv(self.definite)
        self.truth = np.linalg.cholesky(self.covariance) @ draw.standard_normal(n)
        self.seen = self.matrix @ self.truth + noise * draw.standard_normal(30)
        matrix = jnp.asarray(self.matrix)
        self.run = SimpleNamespace(
            theta=jnp.zeros(n),
            residual=jnp.asarray(-self.seen).reshape(1, 10, 3),
            jacobian=lx.FunctionLinearOperator(
                lambda x: (matrix @ x).reshape(1, 10, 3), jax.ShapeDtypeStruct((n,), jnp.float64)
            ),
        )


@pytest.fixture(scope="module")
def linear(exact_problem):
    return Linear(exact_problem, np.random.default_rng(0), 3.0, 0.1)


def test_deviations_are_those_of_the_dense_posterior(linear):
    patterns = find_patterns(linear.run, linear.prior)
    found = deviations(patterns, linear.prior.variances(), Evidence(3.0, 0.1))
    normal = linear.matrix.T @ linear.matrix + 3.0 * linear.definite
    exact = 0.1 * np.sqrt(np.diag(np.linalg.inv(normal)))
    np.testing.assert_allclose(found, exact, rtol=1e-6)


def test_the_evidence_is_the_density_of_the_poses(linear):
    """Against SciPy's density of a normal distribution, with noise and weight as given."""
    patterns = find_patterns(linear.run, linear.prior)
    logs = []
    for weight in (0.3, 3.0, 30.0):
        noise = with_noise(patterns, 30, 1e-12, weight).noise
        inner = linear.matrix @ np.linalg.solve(linear.definite, linear.matrix.T) / weight
        exact = multivariate_normal.logpdf(linear.seen, cov=noise**2 * (np.eye(30) + inner))
        logs.append((weight, exact))
        for other in (0.9, 1.1):  # the noise is the most probable one
            worse = multivariate_normal.logpdf(
                linear.seen, cov=(other * noise) ** 2 * (np.eye(30) + inner)
            )
            assert worse < exact
    best = most_probable(patterns, 30, 1e-12, (0.3, 30.0)).weight
    assert max(logs, key=lambda pair: pair[1])[0] == min(
        (0.3, 3.0, 30.0), key=lambda w: abs(np.log(w / best))
    )


def test_the_weight_and_the_noise_behind_the_poses_are_found(exact_problem):
    """Over 20 draws; one draw of 30 coordinates tells the weight to a factor of about three."""
    found = []
    for seed in range(20):
        linear = Linear(exact_problem, np.random.default_rng(seed), 3.0, 0.1)
        patterns = find_patterns(linear.run, linear.prior)
        found.append(most_probable(patterns, 30, 1e-12, (1e-3, 1e3)))
    weights, noises = np.array(found).T
    assert abs(np.median(np.log(weights / 3.0))) < 0.7
    np.testing.assert_allclose(np.median(noises), 0.1, rtol=0.15)


@pytest.mark.parametrize("radius", [0.0, 0.3])
def test_the_patch_is_told_by_least_squares(exact_problem, radius):
    """One change of all vertices within the radius, against dense algebra; 3,000 draws for 48."""
    n, draw = exact_problem.n_vertices, np.random.default_rng(0)
    points = exact_problem.vertices / exact_problem.mesh.diagonal
    matrix = draw.standard_normal((30, n)) * np.geomspace(1.0, 1e-3, n)
    pulls = draw.standard_normal((3000, 30)) @ matrix
    patterns = Patterns(np.zeros((n, 1)), np.ones(1), np.ones(1), 1.0, pulls)
    near = np.linalg.norm(points[:, None] - points, axis=2) <= radius
    exact = 0.1 / np.linalg.norm(matrix @ near.T, axis=0)
    found = patch_deviations(patterns, points, radius, 0.1)
    np.testing.assert_allclose(found, exact, rtol=0.1)
    unseen = patterns._replace(pulls=np.zeros_like(pulls))
    assert np.isinf(patch_deviations(unseen, points, radius, 0.1)).all()


# ---------------------------------------------------------------- fields recovered


@pytest.mark.parametrize("most", [1, 3])
def test_no_more_evaluations_than_allowed(most):
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
    targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
    pose = jd.deform(problem, targets, 0.5).vertices
    fit = jd.estimate_rigidity_field(problem, pose, start=50.0, max_evaluations=most)
    assert len(fit.history) <= most
    assert fit.result == jd.Result.evaluation_limit


@pytest.mark.slow
def test_a_smooth_field_is_recovered_from_three_poses(bar, bar_problem):
    points = bar.vertices[bar_problem.handles]
    up = np.where(points[:, 1:2] > 75, 30.0, 0.0) * np.array([[0.0, 1.0, 0.0]])
    targets = np.stack([jd.bend(points, 90.0), jd.twist(points, 90.0), points + up])
    true = 0.01 * 1000.0 ** (bar.vertices[:, 1] / 151.0)
    poses = np.stack([np.asarray(jd.deform(bar_problem, t, true).vertices) for t in targets])
    assert len(ends(bar)) == len(points)
    fit = jd.estimate_rigidity_field(bar_problem, poses, smoothness=1e-9, max_evaluations=20)
    assert np.median(np.abs(fit.field / true - 1)) < 0.1


@pytest.mark.slow
def test_the_smoothness_is_chosen_and_the_intervals_cover(bar, bar_problem, bar_targets):
    """One pose, noise 1e-4: the field within a factor of 1.5, intervals that cover."""
    true = 0.01 * 1000.0 ** (bar.vertices[:, 1] / 151.0)
    pose = np.asarray(jd.deform(bar_problem, bar_targets, true).vertices)
    fit = jd.estimate_rigidity_field(bar_problem, noisy(bar, pose, 0), targets=bar_targets)
    free = np.asarray(bar_problem.system.free)[: bar.n_vertices]
    covered = (fit.interval[:, 0] <= true) & (true <= fit.interval[:, 1])
    assert covered[free].mean() > 0.9
    assert np.median(np.abs(np.log(fit.field / true))[free]) < 0.4
    np.testing.assert_allclose(fit.noise, 1e-4 * bar.diagonal, rtol=0.1)
    assert 1e-10 < fit.smoothness < 1e-6
    assert fit.ok


@pytest.mark.slow
def test_total_variation_finds_parts(bar, bar_problem, bar_targets):
    """A band of 30 in 0.3, noise 1e-4: the smooth prior blurs it (median error a fifth)."""
    band = (bar.vertices[:, 1] > 50) & (bar.vertices[:, 1] < 100)
    true = np.where(band, 30.0, 0.3)
    pose = np.asarray(jd.deform(bar_problem, bar_targets, true).vertices)
    fit = jd.estimate_rigidity_field(
        bar_problem, noisy(bar, pose, 0), targets=bar_targets, prior="total_variation"
    )
    free = np.asarray(bar_problem.system.free)[: bar.n_vertices]
    # A quarter of what the smooth prior leaves. 0.029 to 0.031, by how the compiler rounds.
    assert np.median(np.abs(np.log(fit.field / true))[free]) < 0.05
    covered = (fit.interval[:, 0] <= true) & (true <= fit.interval[:, 1])
    assert covered[free].mean() > 0.9
    assert fit.ok
