"""How far the poses determine each part: intervals of rigidity, and verdicts."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._estimation.bounded_gauss_newton import box_solver
from jaxdeform._estimation.noise import NORMAL_95, sandwich
from jaxdeform._estimation.part_model import Fit, PartModel
from jaxdeform._estimation.poses import same_length
from jaxdeform._estimation.search import profile_bound, search

# Up to this half-width (a factor of 1.6) the misfit is close to a parabola in log rigidity.
_WIDE = 0.5
# Evaluations to fit the other parts anew, for each value of the part whose bounds are sought.
_PROFILE_EVALUATIONS = 5


class Curvature(NamedTuple):
    """What the linear model at the best fit says of each part's log rigidity."""

    deviation: Float[np.ndarray, "parts"]
    """Half-width of the 95 % interval."""
    inverse: Float[np.ndarray, "parts"]
    """Diagonal of (J^T W J)^-1."""


def curvature(model: PartModel, best: Fit, modes: np.ndarray | None) -> Curvature:
    """Return the intervals of the linear model."""
    count = len(best.theta)
    floor = same_length(model.problem) ** 2
    # A part without influence gets a wide interval, not a singular matrix.
    ridge = np.finfo(float).eps * (np.trace(best.normal) + floor) * np.eye(count)
    inverse = np.linalg.inv(best.normal + ridge)
    freedom, meat = model.poses.count - count, best.normal
    if modes is not None:
        field = model.field(best.theta)
        freedom, meat = sandwich(
            model.problem, model.poses, field, best.jacobian, modes, model.solver, model.adjoint
        )
    variance = max(best.cost / max(freedom, 1), floor)
    spread = np.diag(inverse @ (meat + ridge) @ inverse)
    return Curvature(NORMAL_95 * np.sqrt(np.maximum(variance * spread, 0.0)), np.diag(inverse))


def profile_cost(
    model: PartModel, best: Fit, modes: np.ndarray | None, part: int, value: float
) -> float:
    """Return the cost with one part fixed at a log rigidity and all others fitted anew."""
    bounds = model.bounds
    bounds[:, part] = value
    evaluate = partial(model.fit, modes=modes)
    fit = evaluate(np.clip(best.theta, *bounds))
    if len(best.theta) > 1:
        fit = search(evaluate, fit, box_solver(*bounds), _PROFILE_EVALUATIONS).best
    return fit.cost


def log_intervals(
    model: PartModel, best: Fit, modes: np.ndarray | None
) -> Float[np.ndarray, "parts 2"]:
    """Return the 95 % interval of each part's log rigidity.

    From the curvature where it is narrow. A wide one is followed to both ends; an end is infinite
    where the cost stays within what noise allows.
    """
    low, high = model.bounds
    linear = curvature(model, best, modes)
    ends = best.theta[:, None] + linear.deviation[:, None] * np.array([-1.0, 1.0])
    for k in np.flatnonzero(linear.deviation > _WIDE).tolist():
        allowed = best.cost + linear.deviation[k] ** 2 / linear.inverse[k]
        cost_at = partial(profile_cost, model, best, modes, k)
        crossing = partial(profile_bound, cost_at, best.theta[k], best.cost, allowed)
        ends[k] = crossing(low[k], -np.inf), crossing(high[k], np.inf)
    return ends


def look_the_same(model: PartModel, best: Fit, tolerance: float) -> Bool[np.ndarray, "parts 2"]:
    """Return whether each part, perfectly soft and perfectly stiff, gives the same poses.

    The same: no vertex that counts moves by more than the tolerance (a length).
    """
    same = np.empty((len(best.theta), 2), bool)
    for k, end in np.ndindex(same.shape):
        theta = best.theta.copy()
        theta[k] = model.bounds[end, k]
        moved = model.fit(theta, None).vertices - best.vertices
        moved = np.where(model.poses.counted[..., None], moved, 0.0)
        same[k, end] = np.linalg.norm(moved, axis=-1).max() <= tolerance
    return same


def verdict(interval: Float[np.ndarray, "2"], same: Bool[np.ndarray, "2"]) -> str:
    """Say in words what is known of a part, softer and stiffer."""
    low, high = interval
    softer, stiffer = same[0] or low == 0.0, same[1] or np.isinf(high)
    if softer and stiffer:
        return "not determined by these poses"
    if stiffer:
        return f"at least {low:.3g}"
    return f"at most {high:.3g}" if softer else "determined"
