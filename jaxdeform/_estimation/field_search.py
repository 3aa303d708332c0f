"""The search for a field of rigidity, under one prior after the other.

Gauss-Newton without matrices: below the residual of the poses stand the weighted differences of log
rigidity along the edges, whose squares add up to the prior.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.system import System
from jaxdeform._estimation.bounded_gauss_newton import Evaluation, ray_solver
from jaxdeform._estimation.deformed import Known, as_known, pose, states
from jaxdeform._estimation.evidence import (
    Evidence,
    Patterns,
    find_patterns,
    most_probable,
    with_noise,
)
from jaxdeform._estimation.field_prior import FLAT, Prior, Solve, WithPrior
from jaxdeform._estimation.poses import Poses, same_length
from jaxdeform._estimation.search import search
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._linalg.waiting import wait_for
from jaxdeform._result import Result, succeeded

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
# Total variation: how often its prior is made anew, and how much stronger each time.
_REWEIGHTINGS, _STRONGER = 20, 2.0


def _stages(smoothness: float) -> Float[np.ndarray, "stages"]:
    """Return the weights of the prior, from a nearly constant field to the weight asked for.

    With a weak prior from the start, the search ends in a ragged field (bar, three exact poses,
    0.01 to 10: median error 97 % instead of 2 %).
    """
    count = max(0, np.ceil(np.log(smoothness / _STRONGEST) / np.log(_RELAX) - 1e-3))
    return np.append(_STRONGEST * _RELAX ** np.arange(count), smoothness)


class FieldSearch:
    """The search, under one weight of the prior after the other."""

    def __init__(self, problem, poses, bounds, solver, adjoint, limit: int, progress) -> None:
        self.problem, self.poses, self.seen = problem, poses, _Observed.of(problem, poses)
        self.bounds = fill_up(bounds, problem.bucket)
        self.solver, self.adjoint, self.limit, self.progress = solver, adjoint, limit, progress
        self.prior = Prior.of(problem)
        self.history: list[float] = []

    def run(self, theta, smoothness: float | None) -> "FieldFound":
        """Search under the smoothness given, or under the one that the poses make most probable."""
        weights = self.problem.mesh.diagonal**2 * _stages(smoothness or _FIRST)
        found = self._relax(self._evaluate(fill_up(theta, self.problem.bucket)), weights)
        return found if smoothness else self._most_probable(found)

    def flatten(self, found: "FieldFound", smoothness: float | None) -> "FieldFound":
        """Search on under total variation, with the smoothness given or the most that poses allow.

        That is where the misfit still is that of the noise (Morozov's discrepancy principle). The
        patterns stay those under the smooth prior.
        """
        strength, count = found.patterns.strength, self.poses.count
        freedom = np.sum(strength / (strength + found.weight))
        most = strongest = np.inf
        prior = self.prior
        if smoothness is None:
            strongest = self.problem.mesh.diagonal**2 * _SMOOTHEST / FLAT
            most = self.misfit(found.run) * np.sqrt(count / max(count - freedom, 1.0))
            most *= 1.0 + 1.0 / np.sqrt(2.0 * count)  # it is known to that
        for k in range(_REWEIGHTINGS):
            theta, before = found.run.theta, prior
            prior = Prior.of(self.problem, found.theta(self.problem))
            # As strong as the smooth prior at first. (A constant field costs nothing under either.)
            costs = [max(x.value(theta), 1e-300) for x in (before, prior)]
            stronger = _STRONGER if k else costs[0] / costs[1]
            weight = found.weight * (1.0 if smoothness else stronger)
            if weight > strongest:
                break
            run, result = self._descend(found.run, prior, weight, self._left)
            if not succeeded(result):
                return found._replace(result=result)
            if self.misfit(run) > most:
                break
            found = found._replace(run=run, weight=float(weight), result=result)
            moved = jnp.abs(run.theta - theta).max()
            if smoothness and moved < FLAT:
                break
        return found

    def misfit(self, run: "_Linearised") -> float:
        """Return the misfit of an evaluation: a length."""
        return self.poses.root_mean_square(np.asarray(run.residual))

    def _most_probable(self, found: "FieldFound") -> "FieldFound":
        """Search on, under the smoothness that the poses make most probable."""
        unit, floor = self.problem.mesh.diagonal**2, same_length(self.problem)
        for _ in range(_ROUNDS):
            run, weight, result, patterns = found
            ends = unit * _ROUGHEST, unit * _SMOOTHEST
            better = most_probable(patterns, self.poses.count, floor, ends).weight
            if max(better / weight, weight / better) < _SAME or not succeeded(result):
                break
            # Down by the stages that are left; up at once.
            stages = weight * _RELAX ** np.arange(1, np.log(weight / better) / -np.log(_RELAX))
            found = self._relax(run, np.append(stages, better))
        return found

    def evidence(self, found: "FieldFound") -> Evidence:
        """Return the weight of a search, and the noise that the poses have under it."""
        floor = same_length(self.problem)
        return with_noise(found.patterns, self.poses.count, floor, found.weight)

    def _relax(self, run, weights) -> "FieldFound":
        """Search under each weight, under the last to the end."""
        for weight in weights[:-1]:
            run, _ = self._descend(run, self.prior, weight, min(_STAGE_EVALUATIONS, self._left))
        run, result = self._descend(run, self.prior, weights[-1], self._left)
        return FieldFound(run, float(weights[-1]), result, find_patterns(run, self.prior))

    @property
    def _left(self) -> int:
        """Evaluations that are left."""
        return max(self.limit - len(self.history), 0)

    def _descend(self, run, prior: Prior, weight, limit: int) -> tuple["_Linearised", Result]:
        first = _FieldFit(run, prior, jnp.asarray(weight, run.theta.dtype))
        solver = ray_solver(self.bounds[0], self.bounds[1], first.solve, _GAIN)
        evaluate = lambda theta: first._replace(run=self._evaluate(theta))  # noqa: E731
        found = search(evaluate, first, solver, limit)
        return found.best.run, found.result

    def _evaluate(self, theta: np.ndarray) -> "_Linearised":
        problem, settings = self.problem, (self.solver, self.adjoint)
        field = np.exp(theta[: problem.n_vertices])
        ends = states(problem, self.poses, field, *settings)
        each = [as_known(problem, *x) for x in zip(self.poses.targets, ends, strict=True)]
        known = jax.tree.map(lambda *x: np.stack(x), *each)
        point = jnp.asarray(theta, problem.dtype)
        run = wait_for(_linearise(problem.system, self.seen, known, point, *settings))
        self.history.append(self.misfit(run))
        if self.progress is not None:
            self.progress(len(self.history), self.history[-1], field)
        return run


# ---------------------------------------------------------------- the linear model


class _Linearised(NamedTuple):
    """One evaluation: deformed poses and their derivative, without the prior.

    Arrays have the size of the problem's bucket; positions are relative to the centre.
    """

    theta: Float[Array, "vertices"]
    vertices: Float[Array, "poses 3 vertices"]
    residual: Float[Array, "poses 3 vertices"]
    jacobian: lx.FunctionLinearOperator


class _Observed(NamedTuple):
    """What the poses are compared with, laid out in the same way."""

    positions: Float[Array | np.ndarray, "poses 3 vertices"]
    counted: Bool[Array | np.ndarray, "poses vertices"]

    @classmethod
    def of(cls, problem: Problem, poses: Poses) -> "_Observed":
        """Lay out the poses of a problem."""
        relative = np.swapaxes(poses.observed - problem.mesh.center, 1, 2).astype(problem.dtype)
        return cls(*(fill_up(x, problem.bucket) for x in (relative, poses.counted)))


@eqx.filter_jit
def _linearise(system: System, seen: _Observed, known: Known, theta, solver, adjoint):
    """Return the evaluation at theta: the same code for all meshes of a bucket."""

    def run(theta):
        field = jnp.exp(theta)
        vertices = jax.lax.map(lambda one: pose(system, one, field, solver, adjoint), known)
        residual = jnp.where(seen.counted[:, None], vertices - seen.positions, 0.0)
        return residual, vertices

    residual, push, vertices = jax.linearize(run, theta, has_aux=True)
    jacobian = lx.FunctionLinearOperator(push, jax.eval_shape(lambda: theta))
    return _Linearised(theta, vertices, residual, jacobian)


class FieldFound(NamedTuple):
    """Where a search under one weight ended, and what the poses tell of the field there."""

    run: _Linearised
    weight: float
    result: Result
    patterns: Patterns

    def theta(self, problem: Problem) -> Float[np.ndarray, "vertices"]:
        """Return the logarithm of the field."""
        return np.asarray(self.run.theta, np.float64)[: problem.n_vertices]

    def vertices(self, problem: Problem) -> Float[np.ndarray, "poses vertices 3"]:
        """Return the fitted poses."""
        relative = np.asarray(self.run.vertices)[..., : problem.n_vertices]
        return np.swapaxes(relative, 1, 2) + problem.mesh.center.astype(relative.dtype)


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
