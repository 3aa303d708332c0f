"""How far the neighbourhood of each part reaches, as observed poses tell it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._checks import check_count, check_function
from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.problem import Problem, precompute
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._errors import ArrayLike
from jaxdeform._estimation.estimate import Estimate
from jaxdeform._estimation.part_model import PartModel
from jaxdeform._estimation.parts import estimate_rigidity, is_exact, least_squares
from jaxdeform._estimation.poses import Poses, check_poses
from jaxdeform._mesh.cells import rings
from jaxdeform._mesh.selection import check_parts
from jaxdeform._result import succeeded

# Larger cells than this cover most of a part.
_MOST = 20
# Larger cells must lower the misfit by this much, or they are not taken.
_GAIN = 0.01
# Searches begin between these materials: beyond them poses hardly change.
_MATERIALS = 1e-3, 10.0
# Rounds over the parts, at most.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class RingsEstimate:
    """The size of the cells of each part, and the rigidity that goes with it.

    **Fields**

    - rings: (parts,) the size of the cells, in rings of vertices.
    - problem: with these cells. Deform other poses with it.
    - fit: the `Estimate` with these cells.
    - tried: (combinations, parts) all sizes that were compared.
    - misfits: (combinations,) the least misfit of each, as a fraction of the diagonal.
    """

    rings: Int[np.ndarray, "parts"]
    problem: Problem
    fit: Estimate
    tried: Int[np.ndarray, "combinations parts"]
    misfits: Float[np.ndarray, "combinations"]

    @property
    def ok(self) -> bool:
        """True if the fit is: it converged, and the model explains the poses."""
        return self.fit.ok

    def explain(self) -> str:
        """Return everything in words: the sizes, and what the fit says."""
        sizes = ", ".join(map(str, self.rings))
        found = f"rings of the parts: {sizes} (of {len(self.tried)} combinations tried)"
        return f"{found}\n{self.fit.explain()}"


def estimate_rings(
    problem: Problem,
    observed: ArrayLike,
    *,
    parts: ArrayLike | None = None,
    targets: ArrayLike | None = None,
    target_noise: float | None = None,
    mask: ArrayLike | None = None,
    most: int = 3,
    progress: Callable[[np.ndarray, float], None] | None = None,
) -> RingsEstimate:
    """Estimate the size of the cells of each part, and its rigidity, from observed poses.

    The size r of the neighbourhood is a property of the material, like the rigidity (thesis Sec.
    2.3): poses of cells of two rings cannot be explained with one ring. Each part has the size for
    which the best rigidities leave the least misfit. First all parts have the same, from 1 to
    ``most``; then each part in turn is given every size, until none changes. A larger size must
    lower the misfit by 1 %: where the poses do not tell, it is the smallest.

    It takes one search for each combination, and compiles once or twice for each size.

    **Arguments**

    - problem: the rest shape with its handles. The size of its cells is not read. Their edge
      weights are, as `precompute` left them.
    - observed, parts, targets, target_noise, mask: as in `estimate_rigidity`. Sizes are compared on
      all vertices that are seen, so mask those that were seen in a wrong place. The noise of the
      targets is for the last fit.
    - most: the largest size to try, at most 20.
    - progress: called after each combination with its sizes (parts,) and its misfit as a fraction
      of the diagonal.

    **Returns** a `RingsEstimate`.

    **Raises** InputError as `estimate_rigidity` does; ``most`` below 1 or above 20.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.square()
        >>> handles = [0, 1, 2, 6, 7, 8]
        >>> wide = jd.precompute(mesh, handles, cells=jd.rings(mesh, 2))
        >>> targets = jd.twist(mesh.vertices[handles], 60.0, along="y")
        >>> pose = jd.deform(wide, targets, 0.5).vertices
        >>> found = jd.estimate_rings(jd.precompute(mesh, handles), pose, targets=targets, most=2)
        >>> int(found.rings[0])
        2
    """
    check_count("most", most, most=_MOST)
    check_function("progress", progress, "sizes, misfit")
    poses = check_poses(problem, observed, targets, mask)
    label = check_parts(parts, problem.mesh)
    search = _Sizes(problem, poses, label, progress)
    best = search.best(most)
    chosen, tried = search.with_sizes(best), search.tried
    given: dict[str, Any] = {"targets": targets, "target_noise": target_noise, "mask": mask}
    fit = estimate_rigidity(chosen, observed, parts=label, start=tried[best].rigidity, **given)
    return RingsEstimate(
        rings=np.array(best),
        problem=chosen,
        fit=fit,
        tried=np.array(list(tried)),
        misfits=np.array([one.misfit for one in tried.values()]),
    )


class _Sizes:
    """The combinations of sizes, with the least misfit of each."""

    def __init__(
        self, problem: Problem, poses: Poses, label: Int[np.ndarray, "vertices"], progress
    ):
        self.problem, self.poses, self.label, self.progress = problem, poses, label, progress
        self.tried: dict[tuple[int, ...], _Tried] = {}

    def best(self, most: int) -> tuple[int, ...]:
        """Return the combination with the least misfit that was found."""
        count = int(self.label.max()) + 1
        best = (1,) * count
        for size in range(1, most + 1):
            best = self._better(best, (size,) * count)
        for _ in range(_ROUNDS if count > 1 else 0):
            before = best
            for part in range(count):
                for size in range(1, most + 1):
                    best = self._better(best, (*best[:part], size, *best[part + 1 :]))
            if best == before:
                break
        return best

    def _better(self, best: tuple[int, ...], other: tuple[int, ...]) -> tuple[int, ...]:
        """Return the combination of less misfit; of two that are as good, that of smaller cells."""
        small, large = sorted((best, other), key=sum)
        narrow, wide = self._try(small), self._try(large)
        gained = not narrow.exact and wide.misfit < (1.0 - _GAIN) * narrow.misfit
        return large if gained else small

    def _try(self, sizes: tuple[int, ...]) -> "_Tried":
        if sizes not in self.tried:
            problem = self.with_sizes(sizes)
            solver = QuasiNewton(leave_saddles=False)
            model = PartModel.build(problem, self.poses, self.label, solver, Implicit())
            # A material stays about the same where its cells grow.
            near = min(self.tried.values(), key=lambda one: one.misfit, default=None)
            start = None if near is None else np.clip(near.material, *_MATERIALS) * model.size
            fit, result = least_squares(model, model.start(start))
            misfit = self.poses.root_mean_square(fit.residual) / problem.mesh.diagonal
            if not succeeded(result):
                misfit = np.inf
            rigidity = np.exp(fit.theta)
            self.tried[sizes] = _Tried(
                misfit, is_exact(model, fit), rigidity / model.size, rigidity
            )
            if self.progress is not None:
                self.progress(np.array(sizes), misfit)
        return self.tried[sizes]

    def with_sizes(self, sizes: tuple[int, ...]) -> Problem:
        """Return the problem with cells of these sizes."""
        problem = self.problem
        wide = rings(problem.mesh, np.array(sizes)[self.label], weights=problem.own_cells.weights)
        return precompute(
            problem.mesh,
            problem.handles,
            cells=wide,
            handle_weights=problem.handle_weights,
            dtype=problem.dtype,
        )


class _Tried(NamedTuple):
    misfit: float
    """As a fraction of the diagonal."""
    exact: bool
    """Whether that is no more than the solver and rounding leave."""
    material: Float[np.ndarray, "parts"]
    rigidity: Float[np.ndarray, "parts"]
