"""Estimating a rigidity that varies over the mesh."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._checks import check_choice, check_count, check_flag, check_function, check_tolerance
from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._errors import ArrayLike
from jaxdeform._estimation.evidence import Evidence, deviations, patch_deviations
from jaxdeform._estimation.field_prior import Prior
from jaxdeform._estimation.field_search import FieldFound, FieldSearch
from jaxdeform._estimation.poses import MEDIUM, check_poses, check_start, log_bounds, sizes
from jaxdeform._result import Result, check_result, succeeded

# Steps are solved to 3e-2 only, so derivatives need not be exact: half the time of the default.
_ADJOINT = Implicit(tolerance=1e-5)
# Half-width of the 95 % interval of the normal distribution, in standard deviations.
_NORMAL_95 = 1.959964
# Radius of the patch that the poses must tell of, in diagonals. A smooth prior extends what it
# knows into parts that nothing strains: of a bar whose end is free, 3 where the rest is 10, the
# interval of that end was 9.99 to 10.02. Patches of the part that is bent are known to 0.7 % (noise
# 1e-4 of the diagonal), those of the free end not to a factor of 1e9.
_PATCH = 0.05


@dataclass(frozen=True, eq=False)
class FieldEstimate:
    """A rigidity per vertex, as `estimate_rigidity_field` finds it.

    **Fields**

    - field: (vertices,) the rigidity of each vertex; its unit is length squared.
    - interval: (vertices, 2) 95 % interval of each, under the smooth prior; no narrower than the
      poses alone, without a prior, tell the rigidity of the patch around it (a twentieth of the
      diagonal to each side). It starts at 0 and ends at infinity where they tell nothing.
    - determined: (vertices,) True where the interval is within a factor of ten to both sides. Where
      it is not, the poses say next to nothing, and the value is that of the neighbours.
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

    def explain(self) -> str:
        """Return everything in words."""
        low, middle, high = np.quantile(self.field, [0.0, 0.5, 1.0])
        share = 100.0 * np.mean(self.determined)
        return (
            f"rigidity {low:.3g} to {high:.3g} (median {middle:.3g}) in squared mesh units, "
            f"determined at {share:.0f} % of the vertices\n"
            f"misfit {self.misfit:.3g} and noise {self.noise:.3g} mesh units, smoothness "
            f"{self.smoothness:.2g} ({len(self.history)} evaluations)\n{Result[self.result]}"
        )


def estimate_rigidity_field(
    problem: Problem,
    observed: ArrayLike,
    *,
    smoothness: float | None = None,
    prior: Literal["smooth", "total_variation"] = "smooth",
    targets: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    solver: Solver = QuasiNewton(leave_saddles=False),  # noqa: B008 (frozen)
    adjoint: Adjoint | None = None,
    max_evaluations: int = 200,
    progress: Callable[[int, float, np.ndarray], None] | None = None,
    throw: bool = False,
) -> FieldEstimate:
    """Estimate a rigidity that varies over the mesh: one unknown per vertex.

    Minimises ``sum |deform(rigidity) - observed|^2 / diagonal^2 + smoothness * t^T L t`` over the
    logarithm t of the rigidity, where L is the cotangent Laplacian: ``t^T L t`` is the integral of
    |grad t|^2 over the surface, a pure number that does not change with scale or resolution. That
    is the smooth prior. Total variation instead counts differences of neighbours by their size, not
    by their square (those below 1 % do as before): the field comes in pieces with borders between
    them (Rudin, Osher and Fatemi, "Nonlinear total variation based noise removal algorithms", 1992,
    doi:10.1016/0167-2789(92)90242-F). It is minimised by reweighted squares, from the smooth field.

    Gauss-Newton, matrix-free: products with J and its transpose are one linear solve each at the
    converged deformation (implicit), inside conjugate gradients that L preconditions.

    **Arguments**

    - problem, observed, targets, mask, solver, adjoint, max_evaluations, progress, throw: as
      `estimate_rigidity`.
    - smoothness: weight of the prior. By default, the one under which the poses are most
      probable (marginal likelihood): ``(noise / (diagonal * slope))^2``, with the standard
      deviation of the noise of a coordinate and of the difference of log rigidity between
      neighbours. More smooths. That of total variation is the largest under which the misfit still
      is that of the noise (Morozov's discrepancy principle).
    - prior: ``"smooth"``, or ``"total_variation"`` for parts of one material each. The second takes
      twice the time.
    - start: a number or (vertices,); a medium material if left out.

    **Returns** a `FieldEstimate`. Its interval takes targets as exact, and is that of the smooth
    prior.

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
    check_choice("prior", prior, ("smooth", "total_variation"))
    check_count("max_evaluations", max_evaluations)
    check_function("progress", progress, "evaluation, misfit, rigidity")
    check_flag("throw", throw)
    if adjoint is None and isinstance(solver, QuasiNewton):
        adjoint = _ADJOINT
    adjoint = choose_adjoint(solver, adjoint)
    poses = check_poses(problem, observed, targets, mask)
    size = sizes(problem)
    medium = np.full(len(size), MEDIUM * np.median(size))
    bounds = log_bounds(size).astype(problem.dtype)
    theta = np.clip(np.log(check_start(start, medium, "vertex")), *bounds)
    search = FieldSearch(problem, poses, bounds, solver, adjoint, max_evaluations, progress)
    smooth = search.run(theta, smoothness)
    evidence = search.evidence(smooth)
    half_width = _half_width(problem, smooth, search.prior, evidence)
    ends = smooth.theta(problem)[:, None] + half_width[:, None] * np.array([-1.0, 1.0])
    found = smooth
    if prior == "total_variation" and succeeded(smooth.result):
        found = search.flatten(smooth, smoothness)
    with np.errstate(over="ignore"):
        interval = np.exp(ends)
    out = FieldEstimate(
        field=np.exp(found.theta(problem)),
        interval=interval,
        determined=half_width <= np.log(10.0),
        smoothness=found.weight / problem.mesh.diagonal**2,
        noise=evidence.noise,
        vertices=found.vertices(problem),
        misfit=search.misfit(found.run),
        history=np.array(search.history),
        result=found.result,
    )
    return check_result(out, throw)


def _half_width(
    problem: Problem, found: FieldFound, prior: Prior, evidence: Evidence
) -> Float[np.ndarray, "vertices"]:
    """Return the half-width of the 95 % interval of log rigidity.

    It is that under the prior, but no less than what the poses alone tell of a patch.
    """
    mesh, patterns = problem.mesh, found.patterns
    smooth = deviations(patterns, prior.variances(), evidence)
    alone = patch_deviations(patterns, mesh.vertices, _PATCH * mesh.diagonal, evidence.noise)
    return _NORMAL_95 * np.maximum(smooth, alone)
