"""Estimating the rigidity of parts from observed poses (thesis Sec. 4.2, and beyond it).

Nonlinear least squares on the logarithm of the rigidity: the residual is the deformed mesh minus
the observed one, and its derivatives go through the deformation. The logarithm keeps the rigidity
positive and makes 'ten times stiffer' the same step everywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._checks import check_count, check_function, check_labels, check_tolerance
from jaxdeform._deformation.alternating import Alternating
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.problem import Problem
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._estimation.bounded_gauss_newton import box_solver
from jaxdeform._estimation.intervals import log_intervals, look_the_same, verdict
from jaxdeform._estimation.noise import handle_modes
from jaxdeform._estimation.part_model import Fit, PartModel
from jaxdeform._estimation.poses import check_poses
from jaxdeform._estimation.search import search
from jaxdeform._result import Result, succeeded


@dataclass(frozen=True, eq=False)
class Estimate:
    """Rigidity as observed poses tell it, with what they do not tell."""

    rigidity: Float[np.ndarray, "parts"]
    """Best value of each part; only a bound is known where the interval reaches 0 or infinity."""
    interval: Float[np.ndarray, "parts 2"]
    """95 % interval of each part. It starts at 0 where the part may be arbitrarily soft, and ends
    at infinity where it may be arbitrarily stiff."""
    verdict: tuple[str, ...]
    """Per part: 'determined', 'at least X' (stiffer makes no visible difference), 'at most X'
    (softer makes none) or 'not determined by these poses'."""
    field: Float[np.ndarray, "vertices"]
    """Rigidity per vertex, as deform takes it."""
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


def estimate_rigidity(
    problem: Problem,
    observed: ArrayLike,
    *,
    parts: ArrayLike | None = None,
    targets: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Solver = Alternating(steps=100),  # noqa: B008 (frozen)
    adjoint: Adjoint | None = None,
    displacement_tolerance: float = 1e-2,
    max_evaluations: int = 50,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
) -> Estimate:
    """Estimate the rigidity of each part from observed poses, all poses together.

    Minimises ``sum |deform(rigidity) - observed|^2`` over the vertices that are free and seen, by
    Gauss-Newton on log rigidity within bounds and a trust region. (Algorithm 1 of the thesis, which
    takes the largest of the estimates of single poses, is :func:`estimate_rigidity_thesis`.)

    The intervals assume that observed positions are the model plus independent noise of equal size
    in all coordinates. If targets are taken from the observed poses, the handles carry that noise
    too and pass it on, often enlarged. The covariance of the residual is then I + D D^T, where D is
    d vertices / d targets. Few of its modes are far from the identity. They are found by random
    probing, and a second search weights the residual by the inverse. A part whose interval is wide
    is followed to both ends, with the other parts fitted anew. Where the misfit cannot be told from
    the best one all the way, the interval ends at 0 or infinity.

    The verdict asks for more, because many vertices together reveal differences that nobody sees.
    If making a part perfectly stiff moves no vertex by more than ``displacement_tolerance``, it is
    'at least' the lower end of the interval; likewise 'at most' for perfectly soft.

    **Arguments**

    - problem: the rest shape with its handles; :func:`find_handles` finds them if need be.
    - observed: (n, 3) or (poses, n, 3) positions.
    - parts: (n,) the part of each vertex, 0 to p - 1; one part by default.
    - targets: (h, 3) or (poses, h, 3) where the handles were put; by default their observed
      positions.
    - mask: (n,) or (poses, n), False where a vertex was not seen; its position is not read.
    - start: first guess, a number or (parts,); a medium material by default.
    - solver, adjoint: as in :func:`deform`. ``Alternating(steps=100)`` with ``Unrolled()`` repeats
      the thesis's deformations; ``QuasiNewton()`` runs them to convergence.
    - displacement_tolerance: the largest displacement of a vertex that does not count as a
      difference between poses (for the verdict), as a fraction of the bounding box diagonal of the
      rest shape.
    - max_evaluations: limit of the search; intervals and verdicts need more evaluations.
    - progress: called after each evaluation with its number, its misfit and the rigidities.

    **Returns** an :class:`Estimate`.

    **Raises** InputError: shapes that do not fit; positions that are seen and not finite; a handle
    that was not seen, without targets; parts with gaps; nothing to observe, because every vertex is
    a handle or masked; settings out of range.

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
    poses = check_poses(problem, observed, targets, mask)
    n = problem.n_vertices
    label = check_parts(np.zeros(n, int) if parts is None else parts, n)
    adjoint = choose_adjoint(solver, adjoint)
    check_tolerance("displacement_tolerance", displacement_tolerance)
    check_count("max_evaluations", max_evaluations)
    check_function("progress", progress, "evaluation, misfit, rigidity")
    model = PartModel.build(problem, poses, label, solver, adjoint)
    found = _search_parts(model, model.start(start), targets is None, max_evaluations, progress)
    best = found.best
    interval = np.exp(log_intervals(model, best, found.modes))
    same = look_the_same(model, best, displacement_tolerance * problem.mesh.diagonal)
    return Estimate(
        rigidity=np.exp(best.theta),
        interval=interval,
        verdict=tuple(map(verdict, interval, same)),
        field=model.field(best.theta),
        vertices=best.vertices,
        misfit=poses.root_mean_square(best.residual),
        history=np.array(found.history),
        result=found.result,
    )


class _FoundParts(NamedTuple):
    best: Fit
    modes: np.ndarray | None
    """Modes of the handles' noise that weight the residual."""
    result: Result
    history: list[float]


def _search_parts(model: PartModel, theta, noisy_handles: bool, limit: int, progress):
    """Search with equal weights, then with those of noisy handles, which depend on the rigidity."""
    history: list[float] = []

    def counted(theta: np.ndarray, modes: np.ndarray | None) -> Fit:
        fit = model.fit(theta, modes)
        history.append(model.poses.root_mean_square(fit.residual))
        if progress is not None:
            progress(len(history), history[-1], np.exp(theta))
        return fit

    solver, modes = box_solver(*model.bounds), None
    first = counted(theta, modes)
    best, result = search(partial(counted, modes=modes), first, solver, limit - len(history))
    if noisy_handles and succeeded(result):
        field = model.field(best.theta)
        modes = np.asarray(
            handle_modes(model.problem, model.poses, field, model.solver, model.adjoint)
        )
        first = model.weighted(best.theta, best, modes)
        best, result = search(partial(counted, modes=modes), first, solver, limit - len(history))
    return _FoundParts(best, modes, result, history)


def check_parts(parts: ArrayLike, n: int) -> Int[np.ndarray, "vertices"]:
    """Return the part of each vertex, or raise InputError naming what is wrong."""
    label = check_labels("parts", parts, n, "vertex", n)
    missing = np.setdiff1d(np.arange(label.max() + 1), label)
    if missing.size:
        raise InputError(
            f"no vertex belongs to part {missing[0]}, though parts go up to {label.max()}: number "
            "them without gaps, as np.unique(parts, return_inverse=True)[1] does"
        )
    return label.astype(np.int32)
