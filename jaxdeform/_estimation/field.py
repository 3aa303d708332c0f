"""Estimating a rigidity that varies smoothly over the mesh.

Gauss-Newton without matrices: below the residual of the poses stand the weighted differences of log
rigidity along the edges, whose squares add up to the prior.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from jaxdeform._checks import check_count, check_function, check_tolerance
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.problem import Problem, rigidity_from_material
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._errors import ArrayLike
from jaxdeform._estimation.bounded_gauss_newton import Evaluation, ray_solver
from jaxdeform._estimation.deformed import pose, states
from jaxdeform._estimation.poses import (
    Poses,
    check_poses,
    check_start,
    log_bounds,
    same_length,
)
from jaxdeform._estimation.search import Found, search
from jaxdeform._linalg.cholesky import Factor, factorise
from jaxdeform._mesh.laplacian import cotangent_weights, graph_laplacian, lifted_weights
from jaxdeform._result import Result, succeeded

# Half-width of the 95 % interval of the normal distribution, in standard deviations.
_NORMAL_95 = 1.959964
# Conjugate gradients of one Gauss-Newton step, which need not be exact.
_CG_TOLERANCE, _CG_STEPS = 1e-2, 60
# The prior is strong at first and weakens by this factor a stage.
_STRONGEST, _RELAX = 1e-2, 0.1
# Evaluations of a stage; the relative gain below which a stage ends, and below which the last does.
_STAGE_EVALUATIONS, _STAGE_GAIN, _LAST_GAIN = 2, 1e-3, 1e-6
# Standard deviations from this many samples are good to 12 %.
_SAMPLES = 32


class FieldEstimate(NamedTuple):
    """A rigidity per vertex, as :func:`estimate_rigidity_field` finds it."""

    field: Float[np.ndarray, "vertices"]
    interval: Float[np.ndarray, "vertices 2"]
    """95 % interval under the prior: wide where only the neighbors say something."""
    vertices: Float[np.ndarray, "poses vertices 3"]
    """The fitted poses."""
    misfit: float
    """Root mean square of the differences between fitted and observed coordinates (a length)."""
    history: Float[np.ndarray, "evaluations"]
    """Misfit of each evaluation, accepted or not."""
    result: Result
    """How the search ended: a member of :class:`Result`."""

    @property
    def ok(self) -> bool:
        """True if the search converged."""
        return bool(succeeded(self.result))


def estimate_rigidity_field(
    problem: Problem,
    observed: ArrayLike,
    *,
    smoothness: float = 1e-8,
    targets: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Solver = QuasiNewton(),  # noqa: B008 (frozen)
    adjoint: Adjoint | None = None,
    max_evaluations: int = 50,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
) -> FieldEstimate:
    """Estimate a rigidity that varies smoothly over the mesh: one unknown per vertex.

    Minimises ``sum |deform(rigidity) - observed|^2 / diagonal^2 + smoothness * t^T L t`` over the
    logarithm t of the rigidity, where L is the cotangent Laplacian: ``t^T L t`` is the integral of
    |grad t|^2 over the surface, a pure number that does not change with scale or resolution.

    Gauss-Newton, matrix-free: products with J and its transpose are one linear solve each at the
    converged deformation (implicit), inside conjugate gradients that L preconditions.

    **Arguments**

    - problem, observed, targets, mask, solver, adjoint, max_evaluations, progress: as
      :func:`estimate_rigidity`.
    - smoothness: weight of the prior. The most probable field has it equal to
      ``(noise / (diagonal * slope))^2``, with the standard deviation of the noise of a coordinate
      and of the difference of log rigidity between neighbours. The default is noise of 1e-4 of the
      bounding box diagonal and slope 1. More smooths.
    - start: a number or (n,); a medium material if left out.

    **Returns** a :class:`FieldEstimate`. Its interval takes targets as exact.

    **Raises** InputError as :func:`estimate_rigidity`; smoothness not above 0.

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
    check_tolerance("smoothness", smoothness, positive=True)
    check_count("max_evaluations", max_evaluations)
    check_function("progress", progress, "evaluation, misfit, rigidity")
    poses = check_poses(problem, observed, targets, mask)
    adjoint = choose_adjoint(solver, adjoint)
    size = _sizes(problem)
    bounds = log_bounds(size).astype(problem.dtype)
    medium = np.full(len(size), 0.1 * np.median(size))
    theta = np.clip(np.log(check_start(start, medium, "vertex")), *bounds)
    prior = _prior(problem)
    history: list[float] = []

    def evaluate(theta: np.ndarray) -> _Linearised:
        run = _linearise(problem, poses, jnp.asarray(theta, problem.dtype), solver, adjoint)
        history.append(poses.root_mean_square(np.asarray(run.residual)))
        if progress is not None:
            progress(len(history), history[-1], np.exp(theta))
        return run

    weights = problem.mesh.diagonal**2 * _stages(smoothness)
    left = lambda: max_evaluations - len(history)  # noqa: E731
    best, result = _search_in_stages(evaluate, theta, bounds, prior, weights, left)
    misfit = poses.root_mean_square(np.asarray(best.run.residual))
    noise = max(misfit, same_length(problem))
    deviation = _NORMAL_95 * noise * np.asarray(_spread(best.evaluation, best.solve))
    theta = np.asarray(best.run.theta, np.float64)
    return FieldEstimate(
        field=np.exp(theta),
        interval=np.exp(theta[:, None] + deviation[:, None] * np.array([-1.0, 1.0])),
        vertices=np.asarray(best.run.vertices),
        misfit=misfit,
        history=np.array(history),
        result=result,
    )


def _sizes(problem: Problem) -> Float[np.ndarray, "vertices"]:
    """Return the rigidity of each vertex at material constant 1 (flat cells: their mean)."""
    size = np.asarray(rigidity_from_material(problem, 1.0), np.float64)
    return np.where(size > 0, size, size.mean())


def _stages(smoothness: float) -> Float[np.ndarray, "stages"]:
    """Return the weights of the prior, from a nearly constant field to the weight asked for.

    With a weak prior from the start, the search ends in a ragged field (bar, three exact poses,
    0.01 to 10: median error 97 % instead of 1 %).
    """
    count = max(0, np.ceil(np.log(smoothness / _STRONGEST) / np.log(_RELAX) - 1e-3))
    return np.append(_STRONGEST * _RELAX ** np.arange(count), smoothness)


def _search_in_stages(
    evaluate: Callable[[np.ndarray], "_Linearised"],
    theta: np.ndarray,
    bounds: np.ndarray,
    prior: "_Prior",
    weights: np.ndarray,
    left: Callable[[], int],
) -> Found:
    """Search under one weight after the other, the last to the end."""
    run = evaluate(theta)
    for weight in weights[:-1]:
        found = _search_stage(evaluate, run, bounds, prior, weight, _STAGE_GAIN, _STAGE_EVALUATIONS)
        run = found.best.run
    return _search_stage(evaluate, run, bounds, prior, weights[-1], _LAST_GAIN, left())


def _search_stage(evaluate, run, bounds, prior, weight, gain, limit) -> Found:
    first = _FieldFit(run, prior, jnp.asarray(weight, run.theta.dtype))
    solver = ray_solver(bounds[0], bounds[1], first.solve, gain)
    return search(lambda theta: first._replace(run=evaluate(theta)), first, solver, limit)


# ---------------------------------------------------------------- the linear model


class _Linearised(NamedTuple):
    """One evaluation: deformed poses and their derivative, without the prior."""

    theta: Float[Array, "vertices"]
    vertices: Float[Array, "poses vertices 3"]
    residual: Float[Array, "poses vertices 3"]
    jacobian: lx.FunctionLinearOperator


def _linearise(problem, poses: Poses, theta, solver, adjoint) -> _Linearised:
    ends = states(problem, poses, np.exp(theta), solver, adjoint)
    state = jax.tree.map(lambda *each: jnp.stack(each), *ends)
    return _linearise_at(problem, poses, theta, state, solver, adjoint)


@eqx.filter_jit
def _linearise_at(problem, poses: Poses, theta, state, solver, adjoint) -> _Linearised:
    def run(theta):
        one = lambda each: pose(problem, each[0], jnp.exp(theta), each[1], solver, adjoint)  # noqa: E731
        vertices = jax.lax.map(one, (poses.targets, state))
        residual = jnp.where(poses.counted[..., None], vertices - poses.observed, 0.0)
        return residual, vertices

    residual, push, vertices = jax.linearize(run, theta, has_aux=True)
    jacobian = lx.FunctionLinearOperator(push, jax.eval_shape(lambda: theta))
    return _Linearised(theta, vertices, residual, jacobian)


class _Prior(NamedTuple):
    """The Laplacian of log rigidity, as a sum over the edges."""

    root: Float[Array, "edges"]
    """Square roots of the edge weights."""
    edges: Int[Array, "edges 2"]
    factor: Factor
    """Of the Laplacian, made definite: the preconditioner."""

    def differences(self, theta: Float[Array, "vertices"]) -> Float[Array, "edges"]:
        """Return weighted differences: the sum of their squares is the prior."""
        return self.root * (theta[self.edges[:, 0]] - theta[self.edges[:, 1]])


class _WithPrior(eqx.Module):
    """The derivative of the residual with the prior below it."""

    data: lx.FunctionLinearOperator
    prior: _Prior
    weight: Float[Array, ""]

    def mv(self, vector):
        """Return the product with a change of log rigidity."""
        return self.data.mv(vector), jnp.sqrt(self.weight) * self.prior.differences(vector)


class _Solve(eqx.Module):
    """Solves for the Gauss-Newton step by conjugate gradients, which the Laplacian preconditions.

    lineax's CG was tried: CG_NOTE
    """

    factor: Factor
    weight: Float[Array, ""]

    def __call__(self, jacobian: lx.AbstractLinearOperator, residual) -> Float[Array, "vertices"]:
        """Return the step."""
        transposed = jacobian.transpose()
        product = lambda x: transposed.mv(jacobian.mv(x))  # noqa: E731
        precondition = lambda r: self.factor.solve(r) / self.weight  # noqa: E731
        right = -transposed.mv(residual)
        return jax.scipy.sparse.linalg.cg(
            product, right, tol=_CG_TOLERANCE, maxiter=_CG_STEPS, M=precondition
        )[0]


class _FieldFit(NamedTuple):
    """One evaluation under the prior of a stage."""

    run: _Linearised
    prior: _Prior
    weight: Float[Array, ""]

    @property
    def solve(self) -> _Solve:
        """Return what solves for the step."""
        return _Solve(self.prior.factor, self.weight)

    @property
    def evaluation(self) -> Evaluation:
        """The linear model as the search takes it."""
        theta, _, residual, jacobian = self.run
        rough = jnp.sqrt(self.weight) * self.prior.differences(theta)
        return Evaluation(theta, (residual, rough), _WithPrior(jacobian, self.prior, self.weight))


@eqx.filter_jit
def _spread(evaluation: Evaluation, solve: Callable) -> Float[Array, "vertices"]:
    """Return the standard deviations of log rigidity for noise of size 1, from samples.

    For normal noise a, H^-1 J^T a has the covariance H^-1, where H = J^T J and J has the prior
    below it.
    """
    theta = evaluation.point
    jacobian = lx.FunctionLinearOperator(evaluation.jacobian.mv, jax.eval_shape(lambda: theta))
    leaves, tree = jax.tree.flatten(evaluation.residual)

    def sample(key):
        keys = jax.random.split(key, len(leaves))
        noise = [
            jax.random.normal(key, leaf.shape, leaf.dtype)
            for key, leaf in zip(keys, leaves, strict=True)
        ]
        return solve(jacobian, jax.tree.unflatten(tree, noise))

    samples = jax.lax.map(sample, jax.random.split(jax.random.key(0), _SAMPLES))
    return jnp.sqrt(jnp.mean(samples**2, axis=0))


# ---------------------------------------------------------------- the prior


def _prior(problem: Problem) -> _Prior:
    mesh = problem.mesh
    # Negative weights would reward differences.
    weights = lifted_weights(cotangent_weights(mesh))
    laplacian = graph_laplacian(mesh.edges, weights, mesh.n_vertices)
    # Constants cost nothing; the preconditioner needs them to cost a little.
    shifted = laplacian + 1e-2 * sp.identity(mesh.n_vertices)
    everywhere = np.ones(mesh.n_vertices, bool)
    factor = factorise(shifted.tocsr(), everywhere, problem.dtype, positions=mesh.vertices)
    root = jnp.asarray(np.sqrt(weights), problem.dtype)
    return _Prior(root, jnp.asarray(mesh.edges, jnp.int32), factor)
