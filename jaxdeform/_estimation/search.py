"""The search for the least misfit, one expensive evaluation after the other.

An evaluation is a deformation with its derivatives: seconds, compiled once, counted and reported on
the host. So optimistix's solver is stepped by hand, and is given what was evaluated instead of a
function to evaluate. On the bar a search takes 5 to 13 evaluations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
import scipy

from jaxdeform._estimation.bounded_gauss_newton import BoundedGaussNewton, Evaluation, recorded
from jaxdeform._linalg.waiting import wait_for
from jaxdeform._result import Result

# Bounds of intervals are good to this much of log rigidity.
_BOUND_WIDTH = 0.05


@eqx.filter_jit
def _begin(solver: BoundedGaussNewton, evaluation: Evaluation):
    shapes = jax.eval_shape(lambda: evaluation.residual)
    point = evaluation.point
    return solver.init(recorded, point, evaluation, {}, shapes, None, frozenset())


@eqx.filter_jit
def _advance(solver: BoundedGaussNewton, point, evaluation: Evaluation, state):
    """Return the best point so far, the next state, whether to stop, and why."""
    arguments = recorded, point, evaluation, {}, state, frozenset()
    point, state, _ = solver.step(*arguments)
    return point, state, *solver.terminate(recorded, point, evaluation, {}, state, frozenset())


@runtime_checkable
class Evaluated(Protocol):
    """What a search evaluates: anything that carries an `Evaluation`."""

    @property
    def evaluation(self) -> Evaluation:
        """The residual and its derivative."""
        ...


class Found(NamedTuple):
    """What a search returns."""

    best: Any
    result: Result


def search(
    evaluate: Callable[[np.ndarray], Evaluated],
    first: Evaluated,
    solver: BoundedGaussNewton,
    max_evaluations: int,
) -> Found:
    """Minimise the residual, from what was evaluated first, by so many evaluations more.

    ``evaluate`` is called on the host, once for each point tried. optimistix's solver is stepped by
    hand, as its documentation shows.
    """
    best = tried = first
    point = first.evaluation.point
    state = _begin(solver, first.evaluation)
    for more in range(max_evaluations, -1, -1):
        point, state, done, why = wait_for(_advance(solver, point, tried.evaluation, state))
        if state.num_steps_since_acceptance == 0:
            best = tried
        if why == optx.RESULTS.nonfinite:
            return Found(best, Result.fit_not_finite)
        if done:
            return Found(best, Result.fitted)
        if more:
            tried = evaluate(np.asarray(state.y_eval))
    return Found(best, Result.evaluation_limit)


# ---------------------------------------------------------------- bounds of intervals


def profile_bound(
    cost_at: Callable[[float], float],
    best: float,
    cost: float,
    allowed: float,
    end: float,
    beyond: float,
) -> float:
    """Return where the cost exceeds what noise allows, on the way from the best value to an end.

    ``beyond`` if it is allowed up to the end. Brent's method on the square root of the excess over
    the least cost: near a minimum that is a straight line (on average 2 to 8 evaluations, where
    bisection took 9 or 10). It is cut off where it is far too large, or not a number.
    """
    known = {best: -1.0}

    def excess(value: float) -> float:
        if value not in known:
            fraction = (cost_at(value) - cost) / (allowed - cost)
            root = np.sqrt(np.clip(np.nan_to_num(fraction, nan=np.inf), 0.0, 16.0))
            known[value] = float(root - 1.0)
        return known[value]

    if excess(end) <= 0.0:
        return beyond
    return float(np.asarray(scipy.optimize.brentq(excess, best, end, xtol=_BOUND_WIDTH)))
