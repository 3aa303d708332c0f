"""How far the poses determine each part: intervals of rigidity, and what a part can do at all."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._estimation.bounded_gauss_newton import box_solver
from jaxdeform._estimation.deformed import State, positions_of
from jaxdeform._estimation.noise import random_effects
from jaxdeform._estimation.part_model import Fit, PartModel
from jaxdeform._estimation.poses import same_length
from jaxdeform._estimation.search import profile_bound, search
from jaxdeform._estimation.spectrum import Spread, spread

# Up to this half-width (a factor of 1.6) the misfit is close to a parabola in log rigidity.
_WIDE = 0.5
# Evaluations to fit the other parts anew, for each value of the part whose bounds are sought.
_PROFILE_EVALUATIONS = 5
# A search has settled if the next step is a small part of the interval, or next to nothing.
_SETTLED, _STILL = 0.5, 1e-6
# Squares of differences, in units of what noise of the handles makes on average. On a bar whose end
# is free it is 0.4 to 0.8 for the free part, above 2,000 for parts that are bent. In units of the
# noise of all coordinates of the handles that average is 0.4 to 1.1: far above it is not computed.
_FELT, _SURELY_FELT = 3.0, 100.0


def linear_spread(model: PartModel, best: Fit, modes: np.ndarray) -> Spread:
    """Return the half-widths of the linear model at the best fit.

    The observed pose may be as far from its minimum as the solver's own end is: that distance, a
    length in all coordinates together, moves a part by at most ``length * sqrt(inverse)``.
    """
    jacobian, residual = best.white
    found = spread(
        jacobian, residual, modes, model.poses.count, same_length(model.problem), best.noise.free
    )
    error = np.linalg.norm(best.solver_error)
    return found._replace(half_width=found.half_width + error * np.sqrt(found.inverse))


def has_settled(model: PartModel, best: Fit, linear: Spread) -> bool:
    """Return whether a further step would stay well within the intervals."""
    step, *_ = np.linalg.lstsq(best.triangle[:, :-1], -best.triangle[:, -1], rcond=1e-7)
    step = np.clip(best.theta + step, *model.bounds) - best.theta
    return bool((np.abs(step) <= _SETTLED * linear.half_width + _STILL).all())


def profile_cost(model: PartModel, best: Fit, part: int, value: float) -> float:
    """Return the cost with one part fixed at a log rigidity and all others fitted anew."""
    bounds = model.bounds
    bounds[:, part] = value
    evaluate = partial(model.fit, noise=best.noise)
    fit = evaluate(np.clip(best.theta, *bounds))
    if len(best.theta) > 1:
        fit = search(evaluate, fit, box_solver(*bounds), _PROFILE_EVALUATIONS).best
    return fit.cost


def log_intervals(model: PartModel, best: Fit, linear: Spread) -> Float[np.ndarray, "parts 2"]:
    """Return the 95 % interval of each part's log rigidity.

    From the linear model where it is narrow. A wide one is followed to both ends; an end is
    infinite where the cost stays within what the spread allows.
    """
    low, high = model.bounds
    ends = best.theta[:, None] + linear.half_width[:, None] * np.array([-1.0, 1.0])
    for k in np.flatnonzero(linear.half_width > _WIDE).tolist():
        allowed = best.cost + linear.half_width[k] ** 2 / linear.inverse[k]
        cost_at = partial(profile_cost, model, best, k)
        crossing = partial(profile_bound, cost_at, best.theta[k], best.cost, allowed)
        ends[k] = crossing(low[k], -np.inf), crossing(high[k], np.inf)
    return ends


class Extremes(NamedTuple):
    """What the rigidities can do to the compared vertices at all (lengths)."""

    displacement: Float[np.ndarray, "parts 2"]
    """How far one moves at most if a part becomes perfectly soft, or perfectly stiff."""
    full_range: float
    """Root mean square difference between all soft and all stiff."""
    felt: Bool[np.ndarray, "parts"]
    """Whether the poses feel it if a part becomes perfectly soft instead of stiff."""


def extremes(model: PartModel, best: Fit) -> Extremes:
    """Make each part perfectly soft and stiff, and all of them."""
    counted = model.poses.counted
    distances = lambda a, b: np.linalg.norm(a - b, axis=-1)[counted]  # noqa: E731
    moved = np.empty((len(best.theta), 2))
    felt = np.empty(len(best.theta), bool)
    all_ends = [model.ends(theta) for theta in model.bounds]
    for k in range(len(best.theta)):
        thetas = np.where(np.arange(len(best.theta)) == k, model.bounds, best.theta)
        ends = all_ends if len(best.theta) == 1 else [model.ends(theta) for theta in thetas]
        moved[k] = [distances(positions_of(end), best.vertices).max() for end in ends]
        felt[k] = _is_felt(model, best, thetas, ends)
    far = distances(*map(positions_of, all_ends))
    return Extremes(moved, float(np.sqrt(np.sum(far**2) / model.poses.count)), felt)


def _is_felt(model: PartModel, best: Fit, thetas: np.ndarray, ends: list[list[State]]) -> bool:
    """Return whether two deformations differ by more than noise of the handles makes them differ.

    A soft part follows the noise of its handles and a stiff one does not. Where nothing else
    strains a part, that alone tells them apart, and makes it look stiff.
    """
    poses, noise = model.poses, best.noise
    square = best.cost / max(poses.count - len(best.theta), 1) * noise.relative**2
    soft, stiff = (np.where(poses.counted[..., None], positions_of(end), 0.0) for end in ends)
    white = noise.whiten((soft - stiff).reshape(len(soft), -1, 1))
    far = float(np.sum(white**2))
    if not noise.relative or far > _SURELY_FELT * square * poses.targets.size:
        return True
    args = model.problem, poses
    soft, stiff = (
        random_effects(*args, model.field(theta), end, model.solver, model.adjoint)
        for theta, end in zip(thetas, ends, strict=True)
    )
    effects = noise.whiten(soft - stiff)
    return bool(far > _FELT * square * np.sum(effects**2) / effects.shape[-1])
