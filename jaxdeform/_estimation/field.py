"""Estimating a rigidity that varies smoothly over the mesh.

Gauss-Newton without matrices: below the residual of the poses stand the weighted differences of log
rigidity along the edges, whose squares add up to the prior.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdeform._checks import check_count, check_flag, check_function, check_tolerance
from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.problem import Problem, rigidity_from_material
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._errors import ArrayLike
from jaxdeform._estimation.bounded_gauss_newton import Evaluation, ray_solver
from jaxdeform._estimation.deformed import Known, as_known, pose, states
from jaxdeform._estimation.evidence import (
    Evidence,
    Patterns,
    deviations,
    find_patterns,
    most_probable,
)
from jaxdeform._estimation.field_prior import Prior, Solve, WithPrior
from jaxdeform._estimation.poses import (
    Poses,
    check_poses,
    check_start,
    log_bounds,
    same_length,
)
from jaxdeform._estimation.search import Found, search
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._linalg.waiting import settled
from jaxdeform._result import Result, check_result, succeeded

# The prior is strong at first and weakens by this factor a stage.
_STRONGEST, _RELAX = 1e-2, 0.1
# The weight at which the most probable one is first asked for.
_FIRST = 1e-5
# Evaluations of a stage, and the relative gain below which it ends: of 1,000 coordinates, that is
# the share of one.
_STAGE_EVALUATIONS, _GAIN = 2, 1e-3
# The smoothness that the poses make most probable is sought between these, anew at most so often,
# until it changes by less than a factor.
_SMOOTHEST, _ROUGHEST, _ROUNDS, _SAME = 1e-1, 1e-12, 3, 2.0
# A step to 1e-2 and patterns need no exact derivatives: half the time of the default.
_ADJOINT = Implicit(tolerance=1e-5)
# Half-width of the 95 % interval of the normal distribution, in standard deviations.
_NORMAL_95 = 1.959964


@dataclass(frozen=True, eq=False)
class FieldEstimate:
    """A rigidity per vertex, as `estimate_rigidity_field` finds it.

    **Fields**

    - field: (vertices,) the rigidity of each vertex; its unit is length squared.
    - interval: (vertices, 2) 95 % interval of each, under the prior.
    - determined: (vertices,) True where the interval is within a factor of ten to both sides. Where
      it is not, the poses say next to nothing, and the value is that of the neighbors.
    - smoothness: weight of the prior, as given or as chosen.
    - noise: standard deviation of a coordinate that the poses have under this prior (a length).
    - vertices: (poses, vertices, 3) the fitted poses.
    - misfit: root mean square of the differences between fitted and observed coordinates (a
      length).
    - history: (evaluations,) misfit of each evaluation, accepted or not.
    - result: how the search ended, a member of `Result`.
    """

    field: Float[np.ndarray, "vertices"]
    interval: Float[np.ndarray, "vertices 2"]
    determined: Bool[np.ndarray, "vertices"]
    smoothness: float
    noise: float
    vertices: Float[np.ndarray, "poses vertices 3"]
    misfit: float
    history: Float[np.ndarray, "evaluations"]
    result: Result

    @property
    def ok(self) -> bool:
        """True if the search converged."""
        return bool(succeeded(self.result))


def estimate_rigidity_field(
    problem: Problem,
    observed: ArrayLike,
    *,
    smoothness: float | None = None,
    targets: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Solver = QuasiNewton(leave_saddles=False),  # noqa: B008 (frozen)
    adjoint: Adjoint | None = None,
    max_evaluations: int = 50,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
    throw: bool = False,
) -> FieldEstimate:
    """Estimate a rigidity that varies smoothly over the mesh: one unknown per vertex.

    Minimises ``sum |deform(rigidity) - observed|^2 / diagonal^2 + smoothness * t^T L t`` over the
    logarithm t of the rigidity, where L is the cotangent Laplacian: ``t^T L t`` is the integral of
    |grad t|^2 over the surface, a pure number that does not change with scale or resolution.

    Gauss-Newton, matrix-free: products with J and its transpose are one linear solve each at the
    converged deformation (implicit), inside conjugate gradients that L preconditions.

    **Arguments**

    - problem, observed, targets, mask, solver, adjoint, max_evaluations, progress, throw: as
      `estimate_rigidity`.
    - smoothness: weight of the prior. Left out, it is the one under which the poses are most
      probable (marginal likelihood): ``(noise / (diagonal * slope))^2``, with the standard
      deviation of the noise of a coordinate and of the difference of log rigidity between
      neighbors. More smooths.
    - start: a number or (n,); a medium material if left out.

    **Returns** a `FieldEstimate`. Its interval takes targets as exact.

    **Raises** InputError as `estimate_rigidity`; smoothness not above 0.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.square()
        >>> problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
        >>> targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
        >>> pose = jd.deform(problem, targets, 0.5).vertices
        >>> jd.estimate_rigidity_field(problem, pose).field.shape
        (9,)
    """
    # Without smoothness, vertices that the poses say nothing about would have no value.
    if smoothness is not None:
        check_tolerance("smoothness", smoothness, positive=True)
    check_count("max_evaluations", max_evaluations)
    check_function("progress", progress, "evaluation, misfit, rigidity")
    check_flag("throw", throw)
    if adjoint is None and isinstance(solver, QuasiNewton):
        adjoint = _ADJOINT
    adjoint = choose_adjoint(solver, adjoint)
    poses = check_poses(problem, observed, targets, mask)
    size = _sizes(problem)
    medium = np.full(len(size), 0.1 * np.median(size))
    bounds = log_bounds(size).astype(problem.dtype)
    theta = np.clip(np.log(check_start(start, medium, "vertex")), *bounds)
    found = _Search(problem, poses, bounds, solver, adjoint, max_evaluations, progress)
    best, weight, result, patterns = found.run(theta, smoothness)
    noise = found.evidence(patterns, (weight, weight)).noise
    spread = deviations(patterns, found.prior.variances(), Evidence(weight, noise))
    theta = np.asarray(best.theta, np.float64)
    ends = _NORMAL_95 * spread[:, None] * np.array([-1.0, 1.0])
    out = FieldEstimate(
        field=np.exp(theta),
        interval=np.exp(theta[:, None] + ends),
        determined=ends[:, 1] <= np.log(10.0),
        smoothness=weight / problem.mesh.diagonal**2,
        noise=noise,
        vertices=np.asarray(best.vertices),
        misfit=poses.root_mean_square(np.asarray(best.residual)),
        history=np.array(found.history),
        result=result,
    )
    return check_result(out, throw)


def _sizes(problem: Problem) -> Float[np.ndarray, "vertices"]:
    """Return the rigidity of each vertex at material constant 1 (flat cells: their mean)."""
    size = np.asarray(rigidity_from_material(problem, 1.0), np.float64)
    return np.where(size > 0, size, size.mean())


def _stages(smoothness: float) -> Float[np.ndarray, "stages"]:
    """Return the weights of the prior, from a nearly constant field to the weight asked for.

    With a weak prior from the start, the search ends in a ragged field (bar, three exact poses,
    0.01 to 10: median error 97 % instead of 2 %).
    """
    count = max(0, np.ceil(np.log(smoothness / _STRONGEST) / np.log(_RELAX) - 1e-3))
    return np.append(_STRONGEST * _RELAX ** np.arange(count), smoothness)


class _Search:
    """The search, under one weight of the prior after the other."""

    def __init__(self, problem, poses, bounds, solver, adjoint, limit: int, progress) -> None:
        self.problem, self.poses, self.bounds = problem, poses, bounds
        self.solver, self.adjoint, self.limit, self.progress = solver, adjoint, limit, progress
        self.prior = Prior.of(problem)
        self.history: list[float] = []

    def run(self, theta, smoothness: float | None) -> "_Found":
        """Search under the smoothness given, or under the one that the poses make most probable."""
        unit = self.problem.mesh.diagonal**2
        ends = unit * _ROUGHEST, unit * _SMOOTHEST
        found = self._relax(self._evaluate(theta), unit * _stages(smoothness or _FIRST))
        for _ in range(0 if smoothness else _ROUNDS):
            run, weight, result, patterns = found
            better = self.evidence(patterns, ends).weight
            if max(better / weight, weight / better) < _SAME or not succeeded(result):
                break
            # Down by the stages that are left; up at once.
            stages = weight * _RELAX ** np.arange(1, np.log(weight / better) / -np.log(_RELAX))
            found = self._relax(run, np.append(stages, better))
        return found

    def evidence(self, patterns: Patterns, ends: tuple[float, float]) -> Evidence:
        """Return the most probable weight and noise."""
        return most_probable(patterns, self.poses.count, same_length(self.problem), ends)

    def _relax(self, run, weights) -> "_Found":
        """Search under each weight, under the last to the end."""
        for weight in weights[:-1]:
            run = self._descend(run, weight, _STAGE_EVALUATIONS).best.run
        left = self.limit - len(self.history)
        found = self._descend(run, weights[-1], max(left, 0))
        run = found.best.run
        return _Found(run, float(weights[-1]), found.result, find_patterns(run, self.prior))

    def _descend(self, run, weight, limit: int) -> Found:
        first = _FieldFit(run, self.prior, jnp.asarray(weight, run.theta.dtype))
        solver = ray_solver(self.bounds[0], self.bounds[1], first.solve, _GAIN)
        return search(lambda theta: first._replace(run=self._evaluate(theta)), first, solver, limit)

    def _evaluate(self, theta: np.ndarray) -> "_Linearised":
        point = jnp.asarray(theta, self.problem.dtype)
        run = _linearise(self.problem, self.poses, point, self.solver, self.adjoint)
        self.history.append(self.poses.root_mean_square(np.asarray(run.residual)))
        if self.progress is not None:
            self.progress(len(self.history), self.history[-1], np.exp(theta))
        return run


# ---------------------------------------------------------------- the linear model


class _Linearised(NamedTuple):
    """One evaluation: deformed poses and their derivative, without the prior."""

    theta: Float[Array, "vertices"]
    vertices: Float[Array, "poses vertices 3"]
    residual: Float[Array, "poses vertices 3"]
    jacobian: lx.FunctionLinearOperator


def _linearise(problem, poses: Poses, theta, solver, adjoint) -> _Linearised:
    ends = states(problem, poses, np.exp(theta), solver, adjoint)
    each = [as_known(problem, *x) for x in zip(poses.targets, ends, strict=True)]
    known = jax.tree.map(lambda *x: np.stack(x), *each)
    return settled(_linearise_at(problem, poses, theta, known, solver, adjoint))


@eqx.filter_jit
def _linearise_at(problem, poses: Poses, theta, known: Known, solver, adjoint) -> _Linearised:
    system = problem.system

    def run(theta):
        field = fill_up(jnp.exp(theta), problem.bucket)
        each = jax.lax.map(lambda one: pose(system, one, field, solver, adjoint), known)
        vertices = jnp.swapaxes(each[..., : problem.n_vertices], 1, 2) + system.center[None, None]
        residual = jnp.where(poses.counted[..., None], vertices - poses.observed, 0.0)
        return residual, vertices

    residual, push, vertices = jax.linearize(run, theta, has_aux=True)
    jacobian = lx.FunctionLinearOperator(push, jax.eval_shape(lambda: theta))
    return _Linearised(theta, vertices, residual, jacobian)


class _Found(NamedTuple):
    """Where a search under one weight ended, and what the poses tell of the field there."""

    run: _Linearised
    weight: float
    result: Result
    patterns: Patterns


class _FieldFit(NamedTuple):
    """One evaluation under the prior of a stage."""

    run: _Linearised
    prior: Prior
    weight: Float[Array, ""]

    @property
    def solve(self) -> Solve:
        """Return what solves for the step."""
        return Solve(self.prior.factor, self.weight)

    @property
    def evaluation(self) -> Evaluation:
        """The linear model as the search takes it."""
        theta, _, residual, jacobian = self.run
        rough = jnp.sqrt(self.weight) * self.prior.differences(theta)
        return Evaluation(theta, (residual, rough), WithPrior(jacobian, self.prior, self.weight))
