"""Gauss-Newton within bounds, as an optimistix solver.

optimistix composes a least-squares solver of a descent (which step of a given size?) and a search
(is the last step accepted, and how large may the next one be?). Its own descents have no bounds and
its searches no largest step: Levenberg-Marquardt and Dogleg, started at 0.01 on a bar of rigidity
30, run off to where everything is rigid (1e46), and no derivative leads back from there. The
descents and the search here have both; the solver around them is optimistix's Gauss-Newton.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

# A step changes a rigidity by at most this factor (20): a full Gauss-Newton step from rubber lands
# where everything is rigid, and no derivative leads back from there.
_LARGEST_STEP = 3.0
# A step shorter than the first is not worth an evaluation. After a rejected step no longer than the
# second, none is tried.
_SHORTEST_STEP, _SHORTEST_RETRY = 1e-9, 1e-6
# A few unknowns are searched until a step is expected to lower the cost by less than this fraction,
# or by less than this fraction of what one of so many values contributes: a step of 0.03 standard
# errors. Where the model does not fit, Gauss-Newton takes ever smaller steps: on the cactus (two
# poses, 31,000 values) the first alone was not reached within 50 evaluations; now it takes 41.
_GAIN, _GAIN_OF_ONE = 1e-10, 1e-3
# Singular values below this fraction of the largest count as zero.
_RANK_TOLERANCE = 1e-7


@runtime_checkable
class Linear(Protocol):
    """A linear map."""

    def mv(self, vector: Any) -> PyTree[Array]:
        """Return the product with a vector."""
        ...


class Evaluation(eqx.Module):
    """The residual at a point, and its derivative there."""

    point: Float[Array, "unknowns"]
    residual: PyTree[Array]
    jacobian: Linear


@eqx.filter_custom_jvp
def _residual(point, *, evaluation: Evaluation):
    return evaluation.residual


@_residual.def_jvp
def _residual_jvp(primals, tangents, *, evaluation: Evaluation):
    return evaluation.residual, evaluation.jacobian.mv(tangents[0])


def recorded(point, evaluation: Evaluation):
    """Return the residual that was evaluated at the point, and its derivative when linearised.

    optimistix linearises the function that it is given at each step. This one costs nothing: the
    deformation is compiled and run elsewhere, once for each point.
    """
    return _residual(point, evaluation=evaluation), None


# ---------------------------------------------------------------- descents


class _BoxState(eqx.Module):
    point: Float[Array, "unknowns"]
    residual: Float[Array, "equations"]
    jacobian: Float[Array, "equations unknowns"]


class BoxDescent(optx.AbstractDescent[Any, Any, Any]):
    """Minimise the linear model within the bounds and a box of half-width step_size.

    Few unknowns: the Jacobian is a matrix.
    """

    lower: Float[Array, "unknowns"]
    upper: Float[Array, "unknowns"]

    def init(self, y, f_info_struct) -> _BoxState:
        """Return a state of the right shapes."""
        rows = f_info_struct.residual
        return _BoxState(
            y, jnp.zeros(rows.shape, rows.dtype), jnp.zeros((rows.size, y.size), rows.dtype)
        )

    def query(self, y, f_info, state) -> _BoxState:
        """Keep the point and the model there."""
        return _BoxState(y, f_info.residual, f_info.jac.as_matrix())

    def step(self, step_size, state: _BoxState):
        """Return the step."""
        low = jnp.maximum(self.lower - state.point, -step_size)
        high = jnp.minimum(self.upper - state.point, step_size)
        step = box_least_squares(state.jacobian, state.residual, low, high)
        return step, optx.RESULTS.successful


class _ActiveSet(NamedTuple):
    step: Float[Array, "unknowns"]
    free: Bool[Array, "unknowns"]
    done: Bool[Array, ""]
    iteration: Int[Array, ""]


def box_least_squares(
    jacobian: Float[Array, "equations unknowns"],
    residual: Float[Array, "equations"],
    low: Float[Array, "unknowns"],
    high: Float[Array, "unknowns"],
) -> Float[Array, "unknowns"]:
    """Minimise ``|J x + r|`` over ``low <= x <= high``, which contain 0, by active sets.

    Bounded-variable least squares (Stark and Parker 1995), begun with all unknowns free. Unknowns
    that the equations do not determine stay where they are (the pseudoinverse).
    """
    pseudoinverse = lx.SVD(rcond=_RANK_TOLERANCE)
    # A slope below this is rounding.
    rounding = 10.0 * jnp.finfo(jacobian.dtype).eps
    rounding *= jnp.linalg.norm(jacobian, axis=0) * jnp.linalg.norm(residual)

    def on_free(free, step):
        """Return the minimum over the free unknowns, with the others as they are."""
        rest = residual + jacobian @ jnp.where(free, 0.0, step)
        operator = lx.MatrixLinearOperator(jnp.where(free[None, :], jacobian, 0.0))
        solution = lx.linear_solve(operator, -rest, pseudoinverse, throw=False).value
        return jnp.where(free, solution, step)

    def iterate(state: _ActiveSet) -> _ActiveSet:
        goal = on_free(state.free, state.step)
        bound = jnp.where(goal < low, low, high)
        outside = state.free & ((goal < low) | (goal > high))
        # The fraction of the way at which each free unknown meets its bound.
        way = jnp.where(outside, (bound - state.step) / jnp.where(outside, goal - state.step, 1), 1)
        first = jnp.argmin(jnp.where(outside, way, jnp.inf))
        hit = outside & (jnp.arange(len(low)) == first)
        fraction = jnp.where(outside.any(), way[first], 1.0)
        step = jnp.where(hit, bound, state.step + fraction * (goal - state.step))
        step = jnp.clip(step, low, high)
        # At the minimum over the free ones, release one that the slope drives off its bound.
        slope = jacobian.T @ (residual + jacobian @ step)
        inwards = jnp.where(step <= low, -slope, 0.0) + jnp.where(step >= high, slope, 0.0)
        inwards = jnp.where(state.free | (low == high), 0.0, inwards)
        released = (inwards > rounding) & (jnp.arange(len(low)) == jnp.argmax(inwards))
        arrived = ~outside.any()
        free = (state.free & ~hit) | (arrived & released)
        return _ActiveSet(step, free, arrived & ~released.any(), state.iteration + 1)

    start = _ActiveSet(
        jnp.zeros_like(low), jnp.ones(len(low), bool), jnp.asarray(False), jnp.asarray(0)
    )
    limit = 4 * len(low) + 4
    end = lax.while_loop(lambda s: ~s.done & (s.iteration < limit), iterate, start)
    return end.step


class RayDescent(optx.AbstractDescent[Any, Any, Any]):
    """Go along the Gauss-Newton step, at most step_size in any unknown, clipped to the bounds.

    Many unknowns: ``solve`` finds the step from the Jacobian, matrix-free, and the residual.
    """

    lower: Float[Array, "unknowns"]
    upper: Float[Array, "unknowns"]
    solve: Callable[[Linear, PyTree[Array]], Float[Array, "unknowns"]]

    def init(self, y, f_info_struct):
        """Return a state of the right shapes."""
        return y, y

    def query(self, y, f_info, state):
        """Solve for the step."""
        return y, self.solve(f_info.jac, f_info.residual)

    def step(self, step_size, state):
        """Return the step."""
        point, full = state
        step = jnp.minimum(1.0, step_size / jnp.maximum(jnp.abs(full).max(), 1e-30)) * full
        return jnp.clip(point + step, self.lower, self.upper) - point, optx.RESULTS.successful


# ---------------------------------------------------------------- the search and the solver


class _TrustRegion(NamedTuple):
    size: Float[Array, ""]
    finite: Bool[Array, ""]
    """Whether the last evaluation was."""


class CappedTrustRegion(optx.AbstractSearch[Any, Any, Any, Any]):
    """optimistix's classical trust region with a largest size, in the maximum norm.

    After a rejection it shrinks from the length that was tried. Bounds may have cut that step below
    the size allowed, and the same step again would be a wasted evaluation.
    """

    largest: Float[Array, ""]
    rule: optx.ClassicalTrustRegion[Any]

    def init(self, y, f_info_struct):
        """Allow the largest step at first."""
        return _TrustRegion(self.largest, jnp.asarray(True))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """Return the size of the next step and whether the last one is taken."""

        def judge():
            # The rule multiplies its size, which is 1 here: so it returns the factor.
            unit = self.rule.init(y, f_info)
            factor, accept, _, _ = self.rule.step(first_step, y, y_eval, f_info, f_eval_info, unit)
            tried = jnp.abs(y_eval - y).max()
            return factor.astype(tried.dtype) * jnp.where(accept, state.size, tried), accept

        # At the first step there is no model yet.
        size, accept = lax.cond(first_step, lambda: (state.size, jnp.asarray(True)), judge)
        size = jnp.minimum(size, self.largest)
        finite = jnp.isfinite(f_eval_info.as_min())
        return size, accept, optx.RESULTS.successful, _TrustRegion(size, finite)


def _silent(**_):
    pass


class BoundedGaussNewton(optx.AbstractGaussNewton[Any, Any, Any]):
    """optimistix's Gauss-Newton with the descents and the search above.

    It ends before a step that the linear model expects to gain less than ``rtol`` of the cost, or
    that is shorter than ``atol``: optimistix's own test needs the evaluation after that step.
    """

    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    descent: BoxDescent | RayDescent
    search: CappedTrustRegion
    norm: Callable[[PyTree], Array] = eqx.field(default=optx.max_norm, static=True)
    verbose: Callable[..., None] = eqx.field(default=_silent, static=True)

    def terminate(self, fn, y, args, options, state, tags):
        """Return whether to stop before the next evaluation, and why."""
        move = state.y_eval - y
        residual = state.f_info.residual
        change = state.f_info.jac.mv(move)
        gain = -_dot(change, jax.tree.map(lambda r, c: 2.0 * r + c, residual, change))
        cost = _dot(residual, residual)
        rejected = state.num_steps_since_acceptance > 0
        stuck = rejected & (state.search_state.size < 0.25 * _SHORTEST_RETRY)
        done = (gain <= self.rtol * cost) | (self.norm(move) < self.atol) | stuck
        finite = jnp.isfinite(cost) & (state.search_state.finite | ~stuck)
        return done, optx.RESULTS.where(finite, optx.RESULTS.successful, optx.RESULTS.nonfinite)


def box_solver(lower: np.ndarray, upper: np.ndarray, values: int = 0) -> BoundedGaussNewton:
    """Return the solver for few unknowns within bounds, of a residual with so many noisy values."""
    gain = max(_GAIN, _GAIN_OF_ONE / values) if values else _GAIN
    return _solver(BoxDescent(jnp.asarray(lower), jnp.asarray(upper)), gain)


def ray_solver(
    lower: np.ndarray, upper: np.ndarray, solve: Callable[..., Any], gain: float
) -> BoundedGaussNewton:
    """Return the solver for many unknowns within bounds, for steps that gain that fraction."""
    return _solver(RayDescent(jnp.asarray(lower), jnp.asarray(upper), solve), gain)


def _solver(descent: BoxDescent | RayDescent, gain: float) -> BoundedGaussNewton:
    number = partial(jnp.asarray, dtype=descent.lower.dtype)
    return BoundedGaussNewton(
        rtol=number(gain),
        atol=number(_SHORTEST_STEP),
        descent=descent,
        search=CappedTrustRegion(number(_LARGEST_STEP), optx.ClassicalTrustRegion()),
    )


def _dot(a: PyTree[Array], b: PyTree[Array]) -> Array:
    products = jax.tree.map(partial(jnp.vdot, precision="highest"), a, b)
    return jax.tree.reduce(jnp.add, products)
