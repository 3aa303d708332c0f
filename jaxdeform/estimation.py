"""Estimating rigidity from observed poses (thesis Sec. 4.2, and beyond it).

Nonlinear least squares on the logarithm of the rigidity: the residual is the deformed mesh minus
the observed one, its derivatives go through the deformation. The logarithm keeps the rigidity
positive and makes 'ten times stiffer' the same step everywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._deformation.adjoint import Implicit, Unrolled
from jaxdeform._deformation.alternating import Alternating
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.solve import deform
from jaxdeform._linalg.cholesky import Factor, factorise
from jaxdeform._linalg.ell import EllMatrix as Rows
from jaxdeform._mesh.laplacian import cotangent_weights, graph_laplacian
from jaxdeform._mesh.mesh import Mesh
from jaxdeform.checks import as_array, check_positions, check_rigidity
from jaxdeform.errors import ArrayLike, InputError

# Outside of these, as material constants (rigidity over tr(B) / 2), nothing changes any more: the
# bar moves by less than 1e-6 of its size from there to zero and to infinity.
_SOFTEST, _STIFFEST = 1e-7, 1e5
# A step changes a rigidity by at most this factor (20): a full Gauss-Newton step from rubber lands
# where everything is rigid, and there no derivative leads back.
_STRIDE = 3.0
# The normal distribution's 95 %.
_Z = 1.959964
# Positions closer than this part of the bounding box diagonal are the same: float32 files round to
# it, and the solvers end there.
_EQUAL = 1e-8
# Up to this half-width (a factor 1.6) the misfit is close enough to a parabola over log rigidity.
_WIDE = 0.5
# Bounds found by bisection are good to this much of log rigidity; each takes about 8 evaluations.
_BOUND_WIDTH = 0.05
# Evaluations to fit the other parts anew, for one value of the part whose bounds are sought.
_PROFILE_EVALUATIONS = 5
# Of the bar's 438 handle coordinates about 40 move the rest by more than themselves.
_MODES = 32
_PROBES = 8
# Conjugate gradients of one Gauss-Newton step of a field: it need not be exact.
_CG_TOLERANCE, _CG_STEPS = 1e-2, 60
# A field is first held smooth by this weight, then let go by this factor a stage.
_ROUGHEST, _RELAX = 1e-2, 0.1
# Standard deviations from so many samples are good to 12 %.
_SAMPLES = 32
# Rounds of growing and fitting again; on the real meshes 3 to 8 are needed.
_GROWTHS = 50


@dataclass(frozen=True, eq=False)
class Estimate:
    """Rigidity as observed poses tell it, with what they do not tell."""

    rigidity: Float[np.ndarray, "parts"]
    """Best value of each part; only a bound is known where the interval reaches 0 or infinity."""
    interval: Float[np.ndarray, "parts 2"]
    """95 % interval of each part; from 0 where it may be any softer, to infinity if stiffer."""
    verdict: tuple[str, ...]
    """Per part: 'determined', 'at least X' (stiffer makes no visible difference), 'at most X'
    (softer makes none) or 'not determined by these poses'."""
    field: Float[np.ndarray, "n"]
    """Rigidity per vertex, as deform takes it."""
    vertices: Float[np.ndarray, "poses n 3"]
    """The fitted poses."""
    misfit: float
    """Root mean square of the differences between fitted and observed coordinates (a length)."""
    history: Float[np.ndarray, "evaluations"]
    """Misfit of each evaluation, accepted or not."""
    result: "Ending"
    """How the search ended, as a sentence."""


class Ending(NamedTuple):
    """How a search ended; ``str(ending)`` is a sentence."""

    ok: bool
    sentence: str

    def __str__(self) -> str:
        """Return the sentence."""
        return self.sentence


_CONVERGED = Ending(True, "Converged: a further step would not lower the misfit visibly.")
_CONVERGED_THESIS = Ending(True, "Stopped: rigidity changed by less than the threshold.")
_AT_LIMIT = Ending(
    False,
    "Stopped at the limit of evaluations: allow more (max_evaluations), or start nearer.",
)
_NOT_FINITE = Ending(
    False,
    "Not finite: a deformation overflowed. Check the scale of the mesh, the observed poses and "
    "the start (rigidity is length squared), or use float64.",
)


# ---------------------------------------------------------------- one rigidity per part


def estimate_rigidity(
    problem: Problem,
    observed: ArrayLike,
    *,
    parts: ArrayLike | None = None,
    targets: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Alternating | QuasiNewton = Alternating(steps=100),  # noqa: B008 (frozen)
    adjoint: Unrolled | Implicit | None = None,
    visible: float = 1e-2,
    max_evaluations: int = 50,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
) -> Estimate:
    """Estimate the rigidity of each part from observed poses, all poses together.

    Minimises ``sum |deform(rigidity) - observed|^2`` over the vertices that are free and seen, by
    Levenberg's and Marquardt's method on log rigidity. (Algorithm 1 of the thesis, which takes the
    largest of the estimates of single poses, is :func:`estimate_rigidity_thesis`.)

    The intervals take the observed positions as the model plus independent noise of equal size at
    all coordinates. Where targets are taken from the observed poses, the handles carry that noise
    too and pass it on, often enlarged: the covariance of the residual is then I + D D^T, where D is
    d vertices / d targets. That is a few dozen modes above the identity, found by random probing,
    and a second search weighs the residual by its inverse. A part whose interval is wide is
    followed to both ends (the other parts fitted anew); where the misfit cannot be told from the
    best one all the way, the interval ends at 0 or infinity.

    The verdict asks for more, because many vertices together betray differences that nobody sees:
    where the pose of a perfectly stiff part differs nowhere by more than ``visible``, it is 'at
    least' the lower end of the interval, and likewise for a perfectly soft one.

    **Arguments**

    - problem: the rest shape with its handles; :func:`find_handles` finds them if need be.
    - observed: (n, 3) or (poses, n, 3) positions.
    - parts: (n,) the part of each vertex, 0 to p - 1; one part if left out.
    - targets: (h, 3) or (poses, h, 3) where the handles were put; their observed positions if left
      out.
    - mask: (n,) or (poses, n), False where a vertex was not seen; its position is not read.
    - start: first guess, a number or (parts,); a medium material if left out.
    - solver, adjoint: as in :func:`deform`. ``Alternating(steps=100)`` with ``Unrolled()`` repeats
      the thesis's deformations; ``QuasiNewton()`` runs them to convergence.
    - visible: the largest displacement of a vertex, as a part of the bounding box diagonal of the
      rest shape, that does not count as a difference between poses (for the verdict).
    - max_evaluations: limit of the search; intervals and verdicts come on top.
    - progress: called after each evaluation with its number, its misfit and the rigidities.

    **Returns** an :class:`Estimate`.

    **Raises** InputError: shapes that do not fit; positions that are seen and not finite; a handle
    that was not seen, without targets; parts with gaps.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.square()
        >>> problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
        >>> targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
        >>> pose = jd.deform(problem, targets, 0.5, solver=jd.Alternating(steps=100)).vertices
        >>> fit = jd.estimate_rigidity(problem, pose)
        >>> fit.verdict
        ('determined',)
    """
    n = problem.n_vertices
    poses = _check_poses(problem, observed, targets, mask)
    label = check_parts(np.zeros(n, int) if parts is None else parts, n)
    count = int(label.max()) + 1
    adjoint = adjoint or (Unrolled() if isinstance(solver, Alternating) else Implicit())
    scale = np.asarray(rigidity_from_material(problem, 1.0), np.float64)
    # A part is as large as its typical cell, and has a size even where its cells have no area.
    size = np.array([np.median(scale[label == k]) for k in range(count)])
    size = np.where(size > 0, size, scale.mean())
    box = np.log([_SOFTEST * size, _STIFFEST * size])
    theta = np.clip(np.log(_check_start(start, 0.1 * size)), *box)
    history: list[float] = []

    def evaluate(theta: np.ndarray, modes: np.ndarray | None) -> _Fit:
        run = _deform_all(problem, poses, label, theta, solver, adjoint)
        vertices, jacobian, residual = map(np.asarray, run)
        return _normal_equations(theta, vertices, jacobian, residual, modes)

    def counted(theta: np.ndarray, modes: np.ndarray | None) -> _Fit:
        at = evaluate(theta, modes)
        history.append(poses.root_mean_square(at.residual))
        if progress is not None:
            progress(len(history), history[-1], np.exp(theta))
        return at

    step = partial(_box_step, box=box)
    modes = None
    at = counted(theta, modes)
    best, ending = _descend(partial(counted, modes=modes), step, at, max_evaluations - 1)
    if targets is None and ending.ok:
        modes = np.asarray(
            _handle_modes(problem, poses, np.exp(best.theta)[label], solver, adjoint)
        )
        at = _normal_equations(best.theta, best.vertices, best.jacobian, best.residual, modes)
        best, ending = _descend(
            partial(counted, modes=modes), step, at, max_evaluations - len(history)
        )
    at_value = partial(evaluate, modes=modes)
    floor = (_EQUAL * _diagonal(problem)) ** 2
    freedom, meat = poses.count - count, best.normal
    if modes is not None:
        field = np.exp(best.theta)[label]
        freedom, meat = _sandwich(problem, poses, field, best.jacobian, modes, solver, adjoint)
    variance = max(best.cost / max(freedom, 1), floor)
    ridge = np.finfo(float).eps * (np.trace(best.normal) + floor)
    inverse = np.linalg.inv(best.normal + ridge * np.eye(count))
    spread = inverse @ meat @ inverse

    def profile(k: int, value: float) -> float:
        """Cost with part k held at a value and all others fitted anew."""
        held = box.copy()
        held[:, k] = value
        at = at_value(np.clip(best.theta, *held))
        if count > 1:
            at, _ = _descend(at_value, partial(_box_step, box=held), at, _PROFILE_EVALUATIONS)
        return at.cost

    def looks_the_same(k: int, value: float) -> bool:
        at = at_value(np.where(np.arange(count) == k, value, best.theta))
        moved = np.where(poses.counted[..., None], at.vertices - best.vertices, 0.0)
        return bool(np.linalg.norm(moved, axis=-1).max() <= visible * _diagonal(problem))

    logs, same = np.empty((count, 2)), np.empty((count, 2), bool)
    for k in range(count):
        deviation = _Z * np.sqrt(max(variance * spread[k, k], 0.0))
        logs[k] = best.theta[k] - deviation, best.theta[k] + deviation
        if deviation > _WIDE:
            allowed = best.cost + deviation**2 / inverse[k, k]
            crossing = partial(_bound, partial(profile, k), best.theta[k], allowed)
            logs[k] = crossing(box[0, k], -np.inf), crossing(box[1, k], np.inf)
        same[k] = looks_the_same(k, box[0, k]), looks_the_same(k, box[1, k])
    interval = np.exp(logs)
    return Estimate(
        rigidity=np.exp(best.theta),
        interval=interval,
        verdict=tuple(map(_verdict, interval, same)),
        field=np.exp(best.theta)[label],
        vertices=best.vertices,
        misfit=poses.root_mean_square(best.residual),
        history=np.array(history),
        result=ending,
    )


def _verdict(interval: Float[np.ndarray, "2"], same: Bool[np.ndarray, "2"]) -> str:
    low, high = interval
    softer, stiffer = same[0] or low == 0.0, same[1] or np.isinf(high)
    if softer and stiffer:
        return "not determined by these poses"
    if stiffer:
        return f"at least {low:.3g}"
    return f"at most {high:.3g}" if softer else "determined"


class _Poses(NamedTuple):
    """The observed poses, as compiled functions take them."""

    targets: Float[np.ndarray, "poses h 3"]
    observed: Float[np.ndarray, "poses n 3"]
    counted: Bool[np.ndarray, "poses n"]
    """Vertices that are free and were seen; the others' positions are 0 here."""

    @property
    def count(self) -> int:
        """Number of coordinates compared."""
        return 3 * int(np.sum(self.counted))

    def root_mean_square(self, residual: Float[np.ndarray, "poses n 3"]) -> float:
        """Return the misfit: a length."""
        return float(np.sqrt(np.sum(residual**2) / max(self.count, 1)))


class _Fit(NamedTuple):
    """One evaluation: the poses at log rigidity theta, and the normal equations there."""

    theta: Float[np.ndarray, "parts"]
    vertices: Float[np.ndarray, "poses n 3"]
    jacobian: Float[np.ndarray, "poses n 3 parts"]
    residual: Float[np.ndarray, "poses n 3"]
    normal: Float[np.ndarray, "parts parts"]
    """J^T W J, W the inverse covariance of the residual (for noise of size 1)."""
    gradient: Float[np.ndarray, "parts"]
    """J^T W r."""
    cost: float
    """r^T W r."""


def _normal_equations(theta, vertices, jacobian, residual, modes) -> _Fit:
    """Weigh the equations by W = (I + U U^T)^-1, U the modes of the handles' noise, or by 1."""
    columns = np.concatenate([jacobian, residual[..., None]], axis=-1)
    columns = columns.reshape(len(residual), -1, len(theta) + 1)
    product = np.einsum("pia,pib->ab", columns, _weigh(columns, modes))
    normal, gradient = product[:-1, :-1], product[:-1, -1]
    return _Fit(theta, vertices, jacobian, residual, normal, gradient, float(product[-1, -1]))


def _weigh(columns: Float[np.ndarray, "poses coordinates k"], modes) -> np.ndarray:
    """Return W times columns; Woodbury: W = I - U (I + U^T U)^-1 U^T."""
    if modes is None:
        return columns
    transposed = np.swapaxes(modes, 1, 2)
    inner = np.eye(modes.shape[2]) + transposed @ modes
    return columns - modes @ np.linalg.solve(inner, transposed @ columns)


def _sandwich(problem, poses, field, jacobian, modes, solver, adjoint) -> tuple[float, np.ndarray]:
    """Return the degrees of freedom tr(W S) - p and J^T W S W J, with S = I + D D^T exactly.

    So the interval is right although the modes in W are few. The trace is Hutchinson's estimate.
    """
    shape, count = poses.observed.shape, jacobian.shape[-1]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (*shape, _PROBES))
    signs = np.where(poses.counted[..., None, None], signs, 0.0)
    flat = np.concatenate([jacobian, signs], axis=-1).reshape(shape[0], -1, count + _PROBES)
    weighed = _weigh(flat, modes)
    rows = np.concatenate([weighed, flat[..., count:]], axis=-1)
    rows = np.moveaxis(rows, -1, 0).reshape(-1, *shape).astype(problem.dtype)
    pulled = np.asarray(_pull_to_handles(problem, poses, field, rows, solver, adjoint))
    pulled = pulled.reshape(len(rows), -1)
    part, both, bare = np.split(pulled, [count, count + _PROBES])
    meat = np.einsum("pia,pib->ab", weighed[..., :count], weighed[..., :count]) + part @ part.T
    trace = np.sum(flat[..., count:] * weighed[..., count:]) + np.sum(both * bare)
    return float(trace) / _PROBES - count, meat


def _deformed(problem: Problem, targets, field, solver, adjoint) -> Float[Array, "poses n 3"]:
    # One pose after the other: the loops of the local step stop early for each.
    pose = lambda t: deform(problem, t, field, solver=solver, adjoint=adjoint).vertices  # noqa: E731
    return jax.lax.map(pose, targets)


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def _deform_all(problem, poses, label, theta, solver, adjoint):
    """Return the deformed poses, their derivatives to theta (forward mode, all parts at once), and
    the residual, both 0 at vertices that do not count."""

    def run(theta):
        return _deformed(problem, poses.targets, jnp.exp(theta)[label], solver, adjoint)

    push = lambda direction: jax.jvp(run, (theta,), (direction,))  # noqa: E731
    vertices, jacobian = jax.vmap(push, out_axes=(None, -1))(jnp.eye(len(theta), dtype=theta.dtype))
    jacobian = jnp.where(poses.counted[..., None, None], jacobian, 0.0)
    return vertices, jacobian, _residual(poses, vertices)


def _residual(poses: _Poses, vertices) -> Float[Array, "poses n 3"]:
    return jnp.where(poses.counted[..., None], vertices - poses.observed, 0.0)


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def _pull_to_handles(problem, poses, field, rows, solver, adjoint) -> Float[Array, "k poses h 3"]:
    """Return D^T of each row."""

    def run(targets):
        return _deformed(problem, targets, field, solver, adjoint)

    _, pull = jax.vjp(run, poses.targets)
    return jax.vmap(pull)(rows)[0]


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def _handle_modes(
    problem, poses, field, solver, adjoint
) -> Float[Array, "poses coordinates modes"]:
    """Return U (per pose) with U U^T nearly D D^T, D = d vertices / d targets.

    A randomised range finder (Halko, Martinsson and Tropp 2011): D^T of random vectors spans the
    motions of the handles that move the rest most.
    """
    count = min(_MODES, 3 * poses.targets.shape[1])

    def modes(targets, counted):
        def run(targets):
            vertices = deform(problem, targets, field, solver=solver, adjoint=adjoint).vertices
            return jnp.where(counted[:, None], vertices, 0.0)

        vertices, pull = jax.vjp(run, targets)
        push = lambda along: jax.jvp(run, (targets,), (along,))[1]  # noqa: E731
        probes = jax.random.normal(jax.random.key(0), (count, *vertices.shape), vertices.dtype)
        (rows,) = jax.vmap(pull)(probes)
        basis, _ = jnp.linalg.qr(rows.reshape(count, -1).T)
        moved = jax.vmap(push)(basis.T.reshape(count, *targets.shape))
        return moved.reshape(count, -1).T

    return jax.lax.map(lambda pose: modes(*pose), (poses.targets, poses.counted))


# ---------------------------------------------------------------- a rigidity that varies smoothly


class FieldEstimate(NamedTuple):
    """A rigidity per vertex, as :func:`estimate_rigidity_field` finds it."""

    field: Float[np.ndarray, "n"]
    interval: Float[np.ndarray, "n 2"]
    """95 % interval under the prior: wide where only the neighbours say something."""
    vertices: Float[np.ndarray, "poses n 3"]
    """The fitted poses."""
    misfit: float
    """Root mean square of the differences between fitted and observed coordinates (a length)."""
    history: Float[np.ndarray, "evaluations"]
    """Misfit of each evaluation, accepted or not."""
    result: Ending


def estimate_rigidity_field(
    problem: Problem,
    observed: ArrayLike,
    *,
    smoothness: float = 1e-8,
    targets: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Alternating | QuasiNewton = QuasiNewton(),  # noqa: B008 (frozen)
    adjoint: Unrolled | Implicit | None = None,
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
    if not (np.isfinite(smoothness) and smoothness > 0):
        raise InputError(
            f"smoothness is {smoothness}: give a number above 0, without it vertices that the "
            "poses say nothing about have no value"
        )
    n, dtype = problem.n_vertices, problem.dtype
    poses = _check_poses(problem, observed, targets, mask)
    adjoint = adjoint or (Unrolled() if isinstance(solver, Alternating) else Implicit())
    size = np.asarray(rigidity_from_material(problem, 1.0), np.float64)
    size = np.where(size > 0, size, size.mean())
    box = np.log([_SOFTEST * size, _STIFFEST * size])
    theta = np.clip(np.log(_check_start(start, np.full(n, 0.1 * np.median(size)))), *box)
    prior, anchor = _prior(problem)
    unit = _diagonal(problem) ** 2
    history: list[float] = []

    def evaluate(theta: np.ndarray, weight: float) -> _FieldFit:
        weighted = prior._replace(weight=jnp.asarray(weight * unit, dtype))
        run = _field_step(problem, poses, weighted, jnp.asarray(theta, dtype), solver, adjoint)
        vertices, residual, move, gain, cost = map(np.asarray, run)
        history.append(poses.root_mean_square(residual))
        if progress is not None:
            progress(len(history), history[-1], np.exp(theta))
        return _FieldFit(theta, vertices, residual, move, float(gain), float(cost))

    def step(at: _FieldFit, radius: float):
        part = min(1.0, radius / max(float(np.abs(at.move).max()), 1e-300))
        move = np.clip(at.theta + part * at.move, *box) - at.theta
        return move, at.gain * part * (2.0 - part)

    # From a nearly constant field to a free one: with a weak prior from the start, the search ends
    # in a ragged field (bar, three exact poses, 0.01 to 10: median error 97 % instead of 1 %).
    weight = max(_ROUGHEST, smoothness)
    while weight > 1.001 * smoothness:
        at_weight = partial(evaluate, weight=weight)
        theta = _descend(at_weight, step, at_weight(theta), 2, enough=1e-3)[0].theta
        weight = max(smoothness, weight * _RELAX)
    at_weight = partial(evaluate, weight=smoothness)
    left = max(0, max_evaluations - len(history) - 1)
    best, ending = _descend(at_weight, step, at_weight(theta), left, enough=1e-6)
    misfit = poses.root_mean_square(best.residual)
    noise = max(misfit, _EQUAL * _diagonal(problem))
    prior = prior._replace(weight=jnp.asarray(smoothness * unit, dtype))
    spread = _field_spread(problem, poses, prior, jnp.asarray(best.theta, dtype), solver, adjoint)
    deviation = _Z * noise * np.asarray(spread)
    del anchor
    return FieldEstimate(
        field=np.exp(best.theta),
        interval=np.exp(best.theta[:, None] + deviation[:, None] * np.array([-1.0, 1.0])),
        vertices=best.vertices,
        misfit=misfit,
        history=np.array(history),
        result=ending,
    )


class _FieldFit(NamedTuple):
    theta: Float[np.ndarray, "n"]
    vertices: Float[np.ndarray, "poses n 3"]
    residual: Float[np.ndarray, "poses n 3"]
    move: Float[np.ndarray, "n"]
    """The Gauss-Newton step."""
    gain: float
    cost: float


class _Prior(NamedTuple):
    """The weighted Laplacian of log rigidity, as compiled functions take it."""

    laplacian: Rows
    factor: Factor
    weight: Float[Array, ""]
    root: Float[Array, "edges"]
    """Square roots of the edge weights: L = D^T root^2 D."""
    edges: Int[Array, "edges 2"]


def _prior(problem: Problem) -> tuple[_Prior, object]:
    """Return the prior, and what keeps its factor alive."""
    mesh = Mesh(problem.vertices, problem.system.faces)
    # Where obtuse angles make them negative, differences would be rewarded.
    weights = cotangent_weights(mesh)
    weights = np.maximum(weights, 1e-3 * np.abs(weights).mean())
    laplacian = graph_laplacian(mesh.edges, weights, mesh.n_vertices)
    # Constants cost nothing; the preconditioner needs them to cost a little.
    shifted = laplacian + 1e-2 * sp.identity(mesh.n_vertices)
    everywhere = np.ones(mesh.n_vertices, bool)
    dtype = problem.dtype
    factor, anchor = factorise(shifted.tocsr(), everywhere, dtype, positions=mesh.vertices)
    prior = _Prior(
        Rows.build([laplacian], dtype),
        factor,
        jnp.ones((), dtype),
        jnp.asarray(np.sqrt(weights), dtype),
        jnp.asarray(mesh.edges, jnp.int32),
    )
    return prior, anchor


def _linear_model(problem, poses, prior, theta, solver, adjoint):
    """Return vertices, residual, J^T, and a solver of (J^T J + weight L) x = right."""

    def run(theta):
        vertices = _deformed(problem, poses.targets, jnp.exp(theta), solver, adjoint)
        return _residual(poses, vertices), vertices

    residual, push, vertices = jax.linearize(run, theta, has_aux=True)
    transposed = jax.linear_transpose(push, theta)
    pull = lambda r: transposed(r)[0]  # noqa: E731

    def solve(right):
        product = lambda x: pull(push(x)) + prior.weight * prior.laplacian.apply(x)  # noqa: E731
        precondition = lambda r: prior.factor.solve(r) / prior.weight  # noqa: E731
        return jax.scipy.sparse.linalg.cg(
            product, right, tol=_CG_TOLERANCE, maxiter=_CG_STEPS, M=precondition
        )[0]

    return vertices, residual, pull, solve


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def _field_step(problem, poses, prior, theta, solver, adjoint):
    """Return what :class:`_FieldFit` holds beside theta."""
    model = _linear_model(problem, poses, prior, theta, solver, adjoint)
    vertices, residual, pull, solve = model
    rough = prior.weight * prior.laplacian.apply(theta)
    gradient = pull(residual) + rough
    move = solve(-gradient)
    cost = jnp.sum(residual**2) + jnp.sum(theta * rough)
    return vertices, residual, move, -jnp.sum(gradient * move), cost


@partial(jax.jit, static_argnames=("solver", "adjoint"))
def _field_spread(problem, poses, prior, theta, solver, adjoint) -> Float[Array, "n"]:
    """Return the standard deviations of log rigidity for noise of size 1, from samples.

    ``H^-1 (J^T a + weight^(1/2) D^T root b)`` with normal a, b has the covariance H^-1.
    """
    *_, pull, solve = _linear_model(problem, poses, prior, theta, solver, adjoint)

    def sample(key):
        first, second = jax.random.split(key)
        shape = poses.observed.shape
        noise = jax.random.normal(first, shape, theta.dtype)
        along = jax.random.normal(second, prior.root.shape, theta.dtype) * prior.root
        i, j = prior.edges[:, 0], prior.edges[:, 1]
        pulled = jnp.zeros_like(theta).at[i].add(along).at[j].add(-along)
        return solve(pull(noise) + jnp.sqrt(prior.weight) * pulled)

    samples = jax.lax.map(sample, jax.random.split(jax.random.key(0), _SAMPLES))
    return jnp.sqrt(jnp.mean(samples**2, axis=0))


# ---------------------------------------------------------------- which vertices were held


class RigidGroup(NamedTuple):
    """Vertices that moved together: ``p' = R p + t`` in every pose."""

    vertices: Int[np.ndarray, "k"]
    rotations: Float[np.ndarray, "poses 3 3"]
    translations: Float[np.ndarray, "poses 3"]
    error: float
    """Largest distance of one of its vertices from that motion."""

    @property
    def degrees(self) -> Float[np.ndarray, "poses"]:
        """Angle of each rotation."""
        cosine = (np.trace(self.rotations, axis1=1, axis2=2) - 1.0) / 2.0
        return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def find_handles(
    mesh: Mesh, deformed: ArrayLike, *, tolerance: float = 1e-6
) -> Int[np.ndarray, "h"]:
    """Find the vertices that were held: those of all groups of :func:`find_handle_groups`.

    **Arguments, Raises**: as there. **Returns** their indices, ascending.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = ((mesh.vertices[:, 1] < 6) | (mesh.vertices[:, 1] > 145)).nonzero()[0]
        >>> problem = jd.precompute(mesh, handles)
        >>> out = jd.deform(problem, jd.bend(mesh.vertices[handles], 90.0), 1.0)
        >>> (jd.find_handles(mesh, out.vertices) == handles).all()
        np.True_
    """
    groups = find_handle_groups(mesh, deformed, tolerance=tolerance)
    return np.unique(np.concatenate([group.vertices for group in groups]))


def find_handle_groups(
    mesh: Mesh, deformed: ArrayLike, *, tolerance: float = 1e-6
) -> tuple[RigidGroup, ...]:
    """Find the connected groups of vertices that moved rigidly, and how they moved.

    The thesis takes the vertices where the best linear map of the 1-ring (Eq. 4.6) is the identity,
    which misses what was turned. Here a vertex whose whole 1-ring moved rigidly is the seed of a
    group; the group grows over neighbours that follow its motion, which is fitted again until
    neither changes. Several poses are taken together: a group moves rigidly in each.

    What merely happens not to deform counts as held too, and may be left out of the handles.

    **Arguments**

    - mesh: the rest shape.
    - deformed: (n, 3) or (poses, n, 3) positions.
    - tolerance: how far a vertex may be off the motion of its group, as a part of the bounding box
      diagonal. The default suits positions stored as float32. With noise, take five times its
      standard deviation (a hundred vertices seldom have one farther off).

    **Returns** the groups, the largest first.

    **Raises** InputError: shapes that do not fit, positions that are not finite, no group found.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> (group,) = jd.find_handle_groups(mesh, mesh.vertices + 1.0)
        >>> len(group.vertices), group.degrees.round(6)
        (722, array([0.]))
    """
    n = mesh.n_vertices
    poses = np.asarray(deformed, np.float64)
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or poses.shape[1:] != (n, 3) or not len(poses):
        raise InputError(
            f"deformed has shape {np.shape(deformed)}: give ({n}, 3) or (poses, {n}, 3), the same "
            "vertices as the mesh"
        )
    bad = np.argwhere(~np.isfinite(poses).all(axis=2))
    if len(bad):
        raise InputError(
            f"vertex {bad[0][1]} of pose {bad[0][0]} is not finite: give real positions"
        )
    if not tolerance > 0:
        raise InputError(
            f"tolerance {tolerance}: give a part of the diagonal above 0, such as 1e-6"
        )
    reach = tolerance * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    i, j = mesh.edges.T
    ones = np.ones(len(i), np.int8)
    graph = sp.csr_matrix(
        sp.coo_matrix((ones, (i, j)), (n, n)) + sp.coo_matrix((ones, (j, i)), (n, n))
    )
    error = _ring_errors(mesh.vertices, poses, graph)
    waiting = error <= reach
    taken = np.zeros(n, bool)
    groups = []
    for seed in np.argsort(error, kind="stable"):
        if not waiting[seed]:
            continue
        group = _grow(mesh.vertices, poses, graph, seed, reach, ~taken)
        waiting[seed] = False
        if group is not None:
            waiting[group.vertices] = False
            taken[group.vertices] = True
            groups.append(group)
    if not groups:
        raise InputError(
            "no handles found: nowhere did a vertex and its neighbours move rigidly within "
            f"{reach:.3g}; raise the tolerance ({tolerance:g} of the diagonal) to about five times "
            "the noise, or name the handles yourself"
        )
    return tuple(sorted(groups, key=lambda group: -len(group.vertices)))


def _rigid_motion(p: Float[np.ndarray, "k 3"], q: Float[np.ndarray, "poses k 3"]):
    """Return R (poses, 3, 3) and t (poses, 3) of the best ``q = R p + t``."""
    middle, moved = p.mean(axis=0), q.mean(axis=1)
    rotation = _rotations(np.einsum("ka,pkb->pba", p - middle, q - moved[:, None]))
    return rotation, moved - rotation @ middle


def _rotations(covariance: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Return the proper rotation nearest to each matrix (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(covariance)
    flip = np.ones(covariance.shape[:-1])
    flip[..., 2] = np.linalg.det(u @ vt)
    return (u * flip[..., None, :]) @ vt


def _off(p, q, rotation, translation) -> Float[np.ndarray, "k"]:
    """Return the largest distance of each vertex from a motion, over the poses."""
    moved = p @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    return np.linalg.norm(moved - q, axis=2).max(axis=0)


def _ring_errors(p, poses, graph: sp.csr_matrix) -> Float[np.ndarray, "n"]:
    """Return how far the 1-ring of each vertex is from moving rigidly; infinite without a ring."""
    n = len(p)
    ring = sp.csr_matrix(graph + sp.identity(n, format="csr"))
    count = np.diff(ring.indptr)
    row, column = np.repeat(np.arange(n), count), ring.indices
    edge = p[column] - p[row]
    error = np.zeros(n)
    for q in poses:
        moved = q[column] - q[row]
        mean = [_sums(row, x, n) / count[:, None] for x in (edge, moved)]
        a, b = edge - mean[0][row], moved - mean[1][row]
        rotation = _rotations(
            _sums(row, (b[:, :, None] * a[:, None, :]).reshape(-1, 9), n).reshape(n, 3, 3)
        )
        off = np.linalg.norm(np.einsum("eij,ej->ei", rotation[row], a) - b, axis=1)
        np.maximum.at(error, row, off)
    return np.where(count > 2, error, np.inf)


def _sums(row, values, n: int) -> np.ndarray:
    return np.stack([np.bincount(row, column, n) for column in values.T], axis=1)


def _grow(p, poses, graph, seed: int, reach: float, allowed) -> RigidGroup | None:
    """Grow a group from the ring of its seed; None where the ring does not stay inside."""
    ring = np.append(graph[[seed]].indices, seed)
    members = ring
    for _ in range(_GROWTHS):
        rotation, translation = _rigid_motion(p[members], poses[:, members])
        follows = np.flatnonzero(allowed & (_off(p, poses, rotation, translation) <= reach))
        if not np.isin(ring, follows).all():
            return None
        _, label = sp.csgraph.connected_components(graph[follows][:, follows], directed=False)
        grown = follows[label == label[np.searchsorted(follows, seed)]]
        if np.array_equal(grown, members):
            break
        members = grown
    rotation, translation = _rigid_motion(p[members], poses[:, members])
    error = _off(p[members], poses[:, members], rotation, translation).max()
    return RigidGroup(members, rotation, translation, float(error))


# ---------------------------------------------------------------- the thesis's rule


class ThesisEstimate(NamedTuple):
    """What :func:`estimate_rigidity_thesis` returns."""

    rigidity: float
    path: Float[np.ndarray, "evaluations"]
    """Rigidity at each evaluation."""
    history: Float[np.ndarray, "evaluations"]
    """Frobenius norm of the difference at each."""
    result: Ending


def estimate_rigidity_thesis(
    problem: Problem,
    observed: ArrayLike,
    *,
    targets: ArrayLike | None = None,
    step_size: float = 0.01,
    threshold: float = 1e-3,
    start: float = 1e-6,
    solver: Alternating | QuasiNewton = Alternating(steps=100),  # noqa: B008 (frozen)
    max_evaluations: int = 1000,
) -> ThesisEstimate:
    """Algorithm 1 of the thesis as written, for comparison: one rigidity, one pose.

    Adds ``step_size * |deformed - observed|_F`` until rigidity changes by less than ``threshold``,
    relatively. It can only increase rigidity, and stops where the steps have become small against
    rigidity, be the misfit small or not. The thesis names neither step size nor threshold.

    **Arguments**: as :func:`estimate_rigidity`; step_size (length), threshold and start as above.

    **Returns** a :class:`ThesisEstimate`. **Raises** InputError as there.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.square()
        >>> problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
        >>> targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
        >>> pose = jd.deform(problem, targets, 0.5).vertices
        >>> bool(jd.estimate_rigidity_thesis(problem, pose).rigidity < 0.4)
        True
    """
    poses = _check_poses(problem, observed, targets, None)
    if len(poses.targets) != 1:
        raise InputError("Algorithm 1 takes one pose: call it for each, and take the largest")
    rigidity, path, history = float(start), [], []
    for _ in range(max_evaluations):
        vertices = deform(problem, poses.targets[0], rigidity, solver=solver).vertices
        path.append(rigidity)
        history.append(float(jnp.linalg.norm(_residual(poses, vertices[None]))))
        if not np.isfinite(history[-1]):
            return ThesisEstimate(rigidity, np.array(path), np.array(history), _NOT_FINITE)
        step = step_size * history[-1]
        rigidity += step
        if step / rigidity < threshold:
            return ThesisEstimate(rigidity, np.array(path), np.array(history), _CONVERGED_THESIS)
    return ThesisEstimate(rigidity, np.array(path), np.array(history), _AT_LIMIT)


# ---------------------------------------------------------------- the search


def _descend(evaluate, step, at, limit: int, enough: float = 1e-10):
    """Gauss-Newton within a trust region; returns the best point and how it ended.

    optimistix's Levenberg-Marquardt and Dogleg know no bounds and keep no history. From 0.01 to 30
    on the bar both run off to where everything is rigid (1e46); with the residual divided by the
    diagonal Levenberg-Marquardt arrives in 16 to 25 evaluations, where this takes 8 to 10. In the
    tests it is the peer.
    """
    radius = _STRIDE
    for _ in range(limit):
        if not np.isfinite(at.cost):
            return at, _NOT_FINITE
        move, gain = step(at, radius)
        length = np.abs(move).max()
        if length < 1e-9 or gain <= enough * at.cost:
            return at, _CONVERGED
        new = evaluate(at.theta + move)
        if new.cost < at.cost:
            at, radius = new, min(2.0 * radius, _STRIDE)
        elif length < 1e-6 and np.isfinite(new.cost):
            return at, _CONVERGED
        else:
            radius = length / 4.0
    return at, _AT_LIMIT


def _box_step(at: _Fit, radius: float, box: Float[np.ndarray, "2 parts"]):
    """Minimise the quadratic model within the bounds and the trust region, and its gain.

    Parts that would leave are set to the border and the others solved again, so that one part
    that the poses do not determine does not hold up the rest.
    """
    low = np.maximum(box[0] - at.theta, -radius)
    high = np.minimum(box[1] - at.theta, radius)
    count = len(at.theta)
    move, inside = np.zeros(count), np.ones(count, bool)
    ridge = 1e-14 * np.trace(at.normal) + np.finfo(float).tiny
    for _ in range(count):
        i = np.flatnonzero(inside)
        right = -at.gradient[i] - at.normal[i][:, ~inside] @ move[~inside]
        move[i] = np.linalg.solve(at.normal[np.ix_(i, i)] + ridge * np.eye(len(i)), right)
        left = inside & ((move < low) | (move > high))
        move = np.clip(move, low, high)
        inside &= ~left
        if not left.any() or not inside.any():
            break
    gain = -(2.0 * at.gradient @ move + move @ at.normal @ move)
    return move, gain


def _bound(cost_at, best: float, allowed: float, end: float, beyond: float) -> float:
    """Return where the cost crosses what noise allows, on the way from the best value to an end."""
    if cost_at(end) <= allowed:
        return beyond
    inside, outside = best, end
    while abs(outside - inside) > _BOUND_WIDTH:
        middle = (inside + outside) / 2.0
        if cost_at(middle) <= allowed:
            inside = middle
        else:
            outside = middle
    return outside


# ---------------------------------------------------------------- checks of the arguments


def _diagonal(problem: Problem) -> float:
    return float(np.linalg.norm(np.ptp(np.asarray(problem.system.rest), axis=1)))


def _check_poses(problem: Problem, observed, targets, mask) -> _Poses:
    n, dtype, handles = problem.n_vertices, problem.dtype, problem.handles
    given = np.asarray(as_array(observed, dtype, "observed"))
    if given.ndim == 2:
        given = given[None]
    if given.ndim != 3 or given.shape[1:] != (n, 3) or not len(given):
        raise InputError(
            f"observed has shape {np.shape(observed)}: give one pose ({n}, 3) or several "
            f"(poses, {n}, 3) of the same mesh as the rest shape"
        )
    poses = len(given)
    seen = np.ones((poses, n), bool) if mask is None else np.asarray(mask)
    if seen.dtype != bool or seen.shape not in ((n,), (poses, n)):
        raise InputError(
            f"mask has shape {seen.shape} and type {seen.dtype}: give booleans ({n},) or "
            f"({poses}, {n}), True where a vertex was seen"
        )
    seen = np.broadcast_to(seen, (poses, n))
    bad = np.argwhere(seen & ~np.isfinite(given).all(axis=2))
    if len(bad):
        pose, vertex = bad[0]
        raise InputError(
            f"vertex {vertex} of observed pose {pose} is {given[pose, vertex].tolist()} "
            f"({len(bad)} such): mark what was not seen with mask"
        )
    if targets is None:
        hidden = np.argwhere(~seen[:, handles])
        if len(hidden):
            pose, row = hidden[0]
            raise InputError(
                f"handle {handles[row]} was not seen in pose {pose} (mask): give targets, or leave "
                "it out of the handles"
            )
        goal = given[:, handles]
    else:
        goal = np.asarray(as_array(targets, dtype, "targets"))
        goal = goal[None] if goal.ndim == 2 else goal
        goal = np.asarray(
            check_positions("targets", goal, (poses, len(handles), 3), dtype, unit="pose")
        )
    counted = seen & np.asarray(problem.system.free)
    return _Poses(goal, np.where(counted[..., None], given, 0.0).astype(dtype), counted)


def check_parts(parts: ArrayLike, n: int) -> Int[np.ndarray, "n"]:
    """Return the part of each vertex, or raise InputError naming what is wrong."""
    label = np.asarray(parts)
    if label.shape != (n,) or label.dtype.kind not in "iu":
        raise InputError(
            f"parts have shape {label.shape} and type {label.dtype}: give one integer per vertex, "
            f"({n},)"
        )
    if label.min() < 0:
        k = int(label.argmin())
        raise InputError(f"the part of vertex {k} is {label[k]}: number the parts from 0")
    missing = np.setdiff1d(np.arange(label.max() + 1), label)
    if missing.size:
        raise InputError(
            f"no vertex belongs to part {missing[0]}, though parts go up to {label.max()}: number "
            "them without gaps, as np.unique(parts, return_inverse=True)[1] does"
        )
    return label.astype(np.int32)


def _check_start(start, default: np.ndarray) -> np.ndarray:
    if start is None:
        return default
    values = np.asarray(check_rigidity(start, len(default), np.dtype(float), name="start"))
    if (values <= 0).any():
        raise InputError("start must be above 0, because the search runs on its logarithm")
    return values
