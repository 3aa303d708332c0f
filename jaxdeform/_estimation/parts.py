"""Estimating the rigidity of parts from observed poses (thesis Sec. 4.2, and beyond it).

Nonlinear least squares on the logarithm of the rigidity: the residual is the deformed mesh minus
the observed one, and its derivatives go through the deformation. The logarithm keeps the rigidity
positive and makes 'ten times stiffer' the same step everywhere.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxdeform._checks import check_count, check_flag, check_function, check_tolerance
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._errors import ArrayLike
from jaxdeform._estimation.bounded_gauss_newton import box_solver
from jaxdeform._estimation.discrepancy import LEVEL, describe, f_test
from jaxdeform._estimation.estimate import Estimate
from jaxdeform._estimation.intervals import extremes, has_settled, linear_spread, log_intervals
from jaxdeform._estimation.noise import HandleNoise, find_handle_noise
from jaxdeform._estimation.outliers import MANY, find_outliers
from jaxdeform._estimation.part_model import Fit, PartModel
from jaxdeform._estimation.poses import check_poses, same_length, without
from jaxdeform._estimation.search import Found, search
from jaxdeform._estimation.smooth_modes import smooth_modes
from jaxdeform._estimation.verdict import Verdict
from jaxdeform._mesh.selection import check_parts
from jaxdeform._result import Result, check_result, succeeded

# Rounds of leaving out vertices that were seen in a wrong place: by more than this fraction of the
# diagonal, which is ten times what solvers leave at their default tolerance.
_OUTLIER_ROUNDS, _MISPLACED = 3, 1e-4
_MAX_EVALUATIONS = 50


def estimate_rigidity(
    problem: Problem,
    observed: ArrayLike,
    *,
    parts: ArrayLike | None = None,
    targets: ArrayLike | None = None,
    target_noise: float | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Solver = QuasiNewton(leave_saddles=False),  # noqa: B008 (frozen)
    adjoint: Adjoint | None = None,
    determined_within: float = 10.0,
    max_evaluations: int = _MAX_EVALUATIONS,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
    throw: bool = False,
) -> Estimate:
    """Estimate the rigidity of each part from observed poses, all poses together.

    Minimises ``sum |deform(rigidity) - observed|^2`` over the vertices that are free and seen, by
    Gauss-Newton on log rigidity within bounds and a trust region. (Algorithm 1 of the thesis, which
    takes the largest of the estimates of single poses, is `estimate_rigidity_thesis`.)

    Poses are taken for equilibria, as `deform` makes them, whatever made them and in whatever
    frame. Where several exist, it is the one next to the observed pose.

    The intervals hold where the model is a little wrong: the variance of the residual is measured
    from its smoothest pattern to its roughest (a sandwich estimate), and the solver's own error is
    added. An F test says whether the model explains the poses at all; if not, ``result`` says so,
    and ``discrepancy`` how far off it is. If targets are taken from the observed poses, the handles
    carry their noise too and pass it on, often enlarged; the residual is weighted for that.

    **Arguments**

    - problem: the rest shape with its handles; `find_handles` finds them if need be.
    - observed: (vertices, 3) or (poses, vertices, 3) positions.
    - parts: (vertices,) the part of each vertex, 0 to p - 1; one part by default. A mask or a
      selection makes two: its vertices are part 1, all others part 0.
    - targets: (handles, 3) or (poses, handles, 3) where the handles were put; by default their
      observed positions.
    - target_noise: noise of the targets, as a multiple of that of the observed vertices. By
      default 0 for targets that were given, and 1 for observed ones. Measured targets given as
      exact make the intervals far too narrow: say 1 then.
    - mask: (vertices,) or (poses, vertices), False where a vertex was not seen; its position is not
      read. Or a selection of the vertices that were seen.
    - start: first guess, a number or (parts,); a medium material by default.
    - solver, adjoint: as in `deform`, but without a look for saddles: poses are observed minima,
      and deformations start from them. Poses that were made by 100 steps of the thesis's iteration
      are no equilibria: fit those with ``Alternating(steps=100)``.
    - determined_within: a side of an interval is open if its end is more than this factor from the
      best value (for the verdict).
    - max_evaluations: limit of the search; intervals need more evaluations.
    - progress: called after each evaluation with its number, its misfit and the rigidities.
    - throw: raise an error if the result is not ``ok``. By default its ``result`` says so.

    **Returns** an `Estimate`; its ``explain()`` says it in words.

    **Raises** InputError: shapes that do not fit; positions that are seen and not finite; a pose in
    another unit, mirrored, or in another frame than its targets; a handle that was not seen,
    without targets; parts with gaps; nothing to observe, because every vertex is a handle or
    masked; settings out of range.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.square()
        >>> problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
        >>> targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
        >>> pose = jd.deform(problem, targets, 0.5).vertices
        >>> fit = jd.estimate_rigidity(problem, pose, targets=targets)
        >>> fit.verdict
        (<Verdict.determined: 'determined'>,)
    """
    check_tolerance("determined_within", determined_within, positive=True)
    check_count("max_evaluations", max_evaluations)
    check_function("progress", progress, "evaluation, misfit, rigidity")
    check_flag("throw", throw)
    adjoint = choose_adjoint(solver, adjoint)
    noise = float(targets is None) if target_noise is None else target_noise
    check_tolerance("target_noise", noise)
    poses = check_poses(problem, observed, targets, mask)
    label = check_parts(parts, problem.mesh)
    model = PartModel.build(problem, poses, label, solver, adjoint)
    found = _Search(model, noise, max_evaluations, progress).run(model.start(start))
    return check_result(_judge(found, poses.counted, max(determined_within, 1.0)), throw)


def least_squares(model: PartModel, theta: np.ndarray) -> Found:
    """Search for the least misfit alone: no outliers, no noise of the handles, no intervals."""
    alone = _Search(model, 0.0, _MAX_EVALUATIONS, None)
    return alone.descend(alone.evaluate(theta, HandleNoise.none(model.poses)))


def is_exact(model: PartModel, fit: Fit) -> bool:
    """Whether the misfit is no more than what the solver and rounding leave."""
    misfit, solver_error = map(model.poses.root_mean_square, (fit.residual, fit.solver_error))
    return bool(misfit <= max(2.0 * solver_error, 10.0 * same_length(model.problem)))


class _Found(NamedTuple):
    model: PartModel
    """With the vertices that were kept."""
    best: Fit
    modes: Float[np.ndarray, "poses vertices modes"]
    p_value: float
    """That the residual is noise."""
    result: Result
    history: list[float]


class _Search:
    """The search in its stages: least squares, outliers, noisy handles, a model that is wrong."""

    def __init__(self, model: PartModel, target_noise: float, limit: int, progress) -> None:
        self.model, self.target_noise, self.limit = model, target_noise, limit
        self.progress = progress
        self.history: list[float] = []

    def run(self, theta: np.ndarray) -> _Found:
        """Search from a first guess."""
        exact = HandleNoise.none(self.model.poses)
        best, result = self.descend(self.evaluate(theta, exact))
        best, result = self._without_outliers(best, result)
        model, poses = self.model, self.model.poses
        if self.target_noise and succeeded(result):
            noise = find_handle_noise(
                model.problem,
                poses,
                model.field(best.theta),
                best.ends,
                model.solver,
                model.adjoint,
                self.target_noise,
            )
            best, result = self.descend(model.weighted(best.theta, best, noise))
        mesh = model.problem.mesh
        modes = smooth_modes(mesh.vertices, poses.counted, mesh.diagonal)
        jacobian, residual = best.white
        p_value = f_test(jacobian, residual, modes, poses.count)
        wrong = p_value < LEVEL and self.target_noise
        if wrong and succeeded(result):
            # Then the handles err as smoothly as the rest, and the weights do not hold.
            noise = best.noise.unbounded
            best, result = self.descend(model.weighted(best.theta, best, noise))
        return _Found(model, best, modes, p_value, result, self.history)

    def evaluate(self, theta: np.ndarray, noise: HandleNoise) -> Fit:
        """Deform into all poses, and tell of it."""
        fit = self.model.fit(theta, noise)
        self.history.append(self.model.poses.root_mean_square(fit.residual))
        if self.progress is not None:
            self.progress(len(self.history), self.history[-1], np.exp(theta))
        return fit

    def descend(self, first: Fit):
        """Search on from an evaluation, under its weights."""
        evaluate = lambda theta: self.evaluate(theta, first.noise)  # noqa: E731
        left = self.limit - len(self.history)
        low, high = self.model.bounds
        solver = box_solver(low, high, self.model.poses.count)
        return search(evaluate, first, solver, left)

    def _without_outliers(self, best: Fit, result: Result):
        whole, first = self.model, (best, result)
        mesh = whole.problem.mesh
        for _ in range(_OUTLIER_ROUNDS):
            poses = self.model.poses
            far = find_outliers(
                mesh.edges, best.residual, poses.counted, _MISPLACED * mesh.diagonal
            )
            if not far.any() or not succeeded(result) or len(self.history) >= self.limit:
                break
            left = poses.counted & ~far
            if np.sum(whole.poses.counted & ~left) > MANY * np.sum(whole.poses.counted):
                self.model = whole
                return first
            self.model = replace(whole, poses=without(whole.problem, poses, far))
            best, result = self.descend(self.evaluate(best.theta, best.noise))
        return best, result


def _judge(found: _Found, counted: np.ndarray, factor: float) -> Estimate:
    """Say how far the fit can be trusted."""
    model, best, result = found.model, found.best, found.result
    problem, poses = model.problem, model.poses
    diagonal = problem.mesh.diagonal
    linear = linear_spread(model, best, found.modes)
    ends = np.full((len(best.theta), 2), [-np.inf, np.inf])
    if succeeded(result):
        if has_settled(model, best, linear):
            ends = log_intervals(model, best, linear)
        else:
            result = Result.unsettled
    reach = extremes(model, best)
    ends[~reach.felt] = -np.inf, np.inf
    misfit, solver_error = map(poses.root_mean_square, (best.residual, best.solver_error))
    p_value = 1.0 if is_exact(model, best) else found.p_value
    discrepancy = describe(
        best.residual, found.modes, poses.count, p_value, diagonal, reach.full_range
    )
    if discrepancy.found and succeeded(result):
        result = Result.unexplained
    rigidity, interval = np.exp(best.theta), np.exp(ends)
    return Estimate(
        rigidity=rigidity,
        material=rigidity / model.size,
        interval=interval,
        verdict=tuple(
            Verdict.of(value, pair, factor) for value, pair in zip(rigidity, interval, strict=True)
        ),
        displacement=reach.displacement,
        discrepancy=discrepancy,
        field=model.field(best.theta),
        vertices=best.vertices,
        misfit=misfit,
        diagonal=diagonal,
        solver_error=solver_error,
        outliers=counted & ~poses.counted,
        history=np.array(found.history),
        result=result,
    )
