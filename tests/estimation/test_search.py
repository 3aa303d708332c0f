"""The search by itself, on residuals in closed form, against SciPy and optimistix."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from helpers import EXACT, PEER, THESIS, noisy
from scipy.optimize import least_squares, lsq_linear

import jaxdeform as jd
from benchmarks.harness import compilations
from jaxdeform._estimation.bounded_gauss_newton import Evaluation, box_least_squares, box_solver
from jaxdeform._estimation.search import profile_bound, search
from jaxdeform._result import succeeded


class Tried(NamedTuple):
    evaluation: Evaluation


class Run(NamedTuple):
    point: np.ndarray
    tried: np.ndarray
    result: jd.Result


def minimise(residual, start, bounds, limit=100) -> Run:
    """Search, and keep every point that was evaluated."""
    tried = []

    def evaluate(point):
        point = jnp.asarray(point)
        tried.append(np.asarray(point))
        jacobian = lx.MatrixLinearOperator(jax.jacfwd(residual)(point))
        return Tried(Evaluation(point, residual(point), jacobian))

    first = evaluate(np.asarray(start, float))
    best, result = search(evaluate, first, box_solver(*np.asarray(bounds, float)), limit)
    return Run(np.asarray(best.evaluation.point), np.array(tried), result)


def rosenbrock(x):
    return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


TIMES = np.linspace(0.0, 4.0, 9)


def decay(x):
    """A misfit that no parameters make 0."""
    seen = 2.0 * np.exp(-0.7 * TIMES) + 0.1 * np.cos(5.0 * TIMES)
    return x[0] * jnp.exp(-x[1] * TIMES) + x[2] - seen


def saturating(x):
    """Like a bar that is rigid already: the slope dies out to both sides."""
    return jnp.stack([1.0 / (1.0 + jnp.exp(-x[0])) - 0.9])


# ---------------------------------------------------------------- within bounds


@pytest.mark.parametrize(
    ("residual", "start", "bounds"),
    [
        (rosenbrock, [-1.2, 1.6], [[-9, -9], [9, 9]]),
        (rosenbrock, [-1.2, 0.3], [[-9, -9], [0.5, 9]]),
        (rosenbrock, [-1.2, 1.6], [[-9, 1.5], [9, 9]]),
        (rosenbrock, [2.0, 1.9], [[1.5, -9], [9, 2.0]]),
        (decay, [0.1, 0.1, 0.1], [[-9, -9, -9], [9, 9, 9]]),
        (decay, [0.1, 0.1, 0.3], [[0, 0, 0.2], [1.5, 9, 9]]),
        (decay, [0.1, 0.1, -0.1], [[-9, 0, -0.5], [9, 0.5, -0.05]]),
    ],
)
def test_it_ends_where_scipy_ends(residual, start, bounds):
    found = minimise(residual, start, bounds)
    peer = least_squares(
        lambda x: np.asarray(residual(jnp.asarray(x))),
        start,
        jac=lambda x: np.asarray(jax.jacfwd(residual)(jnp.asarray(x))),
        bounds=bounds,
        method="trf",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    assert succeeded(found.result)
    np.testing.assert_allclose(found.point, peer.x, atol=1e-5)  # TRF stays inside the bounds
    cost = float(jnp.sum(residual(jnp.asarray(found.point)) ** 2))
    assert cost <= 2.0 * peer.cost * (1 + PEER) + EXACT


@pytest.mark.parametrize("start", [[0.1, 0.1, 0.1], [5.0, 2.0, -3.0]])
def test_it_ends_where_optimistix_ends_without_bounds(start):
    """To 1e-4: the search leaves the last 1e-10 of the cost, which is 1e-5 of a misfit."""
    found = minimise(decay, start, [[-50] * 3, [50] * 3])
    peer = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    expected = optx.least_squares(lambda x, _: decay(x), peer, jnp.asarray(start))
    np.testing.assert_allclose(found.point, expected.value, rtol=1e-4)
    assert len(found.tried) <= int(expected.stats["num_steps"])


@pytest.mark.parametrize("start", [-6.0, 8.0])
def test_steps_are_capped_and_stay_within_bounds(start):
    """A full Gauss-Newton step from -6 is 360 long."""
    found = minimise(saturating, [start], [[-7.0], [9.0]])
    assert np.abs(np.diff(found.tried[:, 0])).max() <= 3.0 + EXACT
    assert found.tried.min() >= -7.0
    assert found.tried.max() <= 9.0
    np.testing.assert_allclose(found.point, np.log(9.0), rtol=PEER)


def test_what_is_not_determined_stays_where_it_was():
    """x0 + x1 is determined, their difference and x2 are not."""

    def residual(x):
        return jnp.stack([x[0] + x[1] - 3.0, 2.0 * (x[0] + x[1]) - 7.0])

    found = minimise(residual, [0.5, -0.5, 4.0], [[-9] * 3, [9] * 3])
    assert succeeded(found.result)
    np.testing.assert_allclose(found.point, [2.2, 1.2, 4.0], rtol=PEER)


def test_an_exact_start_is_one_evaluation():
    found = minimise(rosenbrock, [1.0, 1.0], [[-9, -9], [9, 9]])
    assert succeeded(found.result)
    assert len(found.tried) == 1


# ---------------------------------------------------------------- what is not finite, and limits


def test_a_step_into_nan_is_taken_back():
    """From 1 the first step leads to -0.8, whose root is not a number."""
    found = minimise(lambda x: jnp.sqrt(x) - 0.1, [1.0], [[-9], [9]])
    assert succeeded(found.result)
    np.testing.assert_allclose(found.point, 0.01, rtol=PEER)


def test_it_says_when_nothing_is_finite():
    everywhere = minimise(lambda x: x * jnp.nan, [1.0], [[-9], [9]])
    around = minimise(lambda x: jnp.where(x == 1.0, x, jnp.nan), [1.0], [[-9], [9]])
    for found in (everywhere, around):
        assert not succeeded(found.result)
        assert "Not finite" in str(found.result)
        np.testing.assert_array_equal(found.point, [1.0])
    assert len(everywhere.tried) == 1


@pytest.mark.parametrize("limit", [0, 1, 4])
def test_it_keeps_to_the_limit(limit):
    found = minimise(rosenbrock, [-1.2, 1.6], [[-9, -9], [9, 9]], limit)
    assert not succeeded(found.result)
    assert len(found.tried) == 1 + limit
    costs = [float(jnp.sum(rosenbrock(x) ** 2)) for x in found.tried]
    np.testing.assert_array_equal(found.point, found.tried[np.argmin(costs)])


def test_a_second_search_compiles_nothing():
    minimise(decay, [0.1, 0.1, 0.1], [[-9] * 3, [9] * 3], limit=2)
    first = Tried(
        Evaluation(jnp.zeros(3), decay(jnp.zeros(3)), lx.MatrixLinearOperator(jnp.ones((9, 3))))
    )
    solver = box_solver(np.full(3, -1.0), np.full(3, 2.0))
    with compilations() as compiled:
        search(lambda _: first, first, solver, 3)
    assert compiled == []


# ---------------------------------------------------------------- the step within a box


def test_the_step_is_the_minimum_within_the_box():
    """Against SciPy's bounded-variable least squares, bounds at 0 and ill conditions included."""
    draw = np.random.default_rng(0)
    step = jax.jit(box_least_squares)
    for _ in range(100):
        jacobian = draw.standard_normal((7, 5)) @ (np.eye(5) + 3.0 * draw.standard_normal((5, 5)))
        residual = 10.0 * draw.standard_normal(7)
        low, high = -2.0 * draw.random(5), 2.0 * draw.random(5)
        low[draw.random(5) < 0.2] = 0.0
        high[(draw.random(5) < 0.2) & (low < 0)] = 0.0
        found = np.asarray(step(jacobian, residual, low, high))
        peer = lsq_linear(jacobian, -residual, (low, high), method="bvls", tol=1e-14)
        assert (found >= low).all()
        assert (found <= high).all()
        cost = np.sum((jacobian @ found + residual) ** 2)
        assert cost <= 2.0 * peer.cost * (1.0 + EXACT)


# ---------------------------------------------------------------- bounds of intervals


def bound(cost, end, beyond=np.inf):
    """Return the bound from 0, where the cost is 1, to where it is 2, and the evaluations."""
    calls = []
    value = profile_bound(lambda x: calls.append(x) or cost(x), 0.0, 1.0, 2.0, end, beyond)
    return value, len(calls)


@pytest.mark.parametrize(
    ("cost", "end", "expected", "evaluations"),
    [
        (lambda x: 1.0 + (x / 3.0) ** 2, 20.0, 3.0, 4),
        (lambda x: 1.0 + (x / 3.0) ** 2, -20.0, -3.0, 4),
        (lambda x: 1.0 + 1.2 * (1.0 - np.exp(-((x / 2.0) ** 2))), -25.0, -2.677, 9),
        (lambda x: 1.0 + 2.0 * (x > 4.7), 20.0, 4.7, 13),
        (lambda x: 1.0 + (x / 3.0) ** 2 if x < 4.0 else np.nan, 20.0, 3.0, 10),
        (lambda x: np.nan if x > 2.0 else 0.9, 20.0, 2.0, 13),
    ],
)
def test_bounds_are_found(cost, end, expected, evaluations):
    value, count = bound(cost, end)
    assert abs(value - expected) <= 0.05  # as good as they are promised to be
    assert count <= evaluations


def test_a_cost_allowed_to_the_end_has_no_bound():
    assert bound(lambda x: 1.0 + 0.04 * x, 20.0) == (np.inf, 1)
    assert bound(lambda x: 1.5, -20.0, -np.inf) == (-np.inf, 1)


# ---------------------------------------------------------------- with deformations


@pytest.mark.slow
def test_the_search_says_when_it_was_cut_short(bar_problem, bar_targets, equilibrium_of):
    fit = jd.estimate_rigidity(
        bar_problem, equilibrium_of(30.0), targets=bar_targets, start=0.01, max_evaluations=2
    )
    assert fit.interval.tolist() == [[0.0, np.inf]]  # nothing is known of where it would end
    assert not fit.ok
    assert len(fit.history) == 2
    assert "max_evaluations" in str(fit.result)


@pytest.mark.slow
def test_optimistix_ends_at_the_same_minimum(bar, bar_problem, bar_targets, pose_of):
    seen = noisy(bar, pose_of(1.0), seed=2)
    fit = jd.estimate_rigidity(bar_problem, seen, targets=bar_targets, solver=THESIS)
    free = np.flatnonzero(np.asarray(bar_problem.system.free))

    def residual(theta, _):
        out = jd.deform(bar_problem, bar_targets, jnp.exp(theta), solver=THESIS)
        return (out.vertices[free] - seen[free]) / bar.diagonal

    peer = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    found = optx.least_squares(residual, peer, jnp.asarray(0.0)).value
    np.testing.assert_allclose(fit.rigidity[0], jnp.exp(found), rtol=1e-6)


# ---------------------------------------------------------------- throw


@pytest.mark.parametrize(
    "estimate",
    [
        jd.estimate_rigidity,
        pytest.param(jd.estimate_rigidity_field, marks=pytest.mark.slow),
        jd.estimate_rigidity_thesis,
    ],
    ids=["parts", "field", "thesis"],
)
def test_throw_raises_what_the_result_says(estimate):
    mesh = jd.shapes.square()
    problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
    targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
    pose = jd.deform(problem, targets, 0.5).vertices
    given = {"targets": targets, "max_evaluations": 1}
    assert estimate(problem, pose, **given).result == jd.Result.evaluation_limit
    with pytest.raises(eqx.EquinoxRuntimeError, match="Stopped at the limit of evaluations"):
        estimate(problem, pose, throw=True, **given)
