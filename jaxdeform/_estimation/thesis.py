"""Algorithm 1 of the thesis, for comparison."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxdeform._checks import check_count, check_flag, check_tolerance
from jaxdeform._deformation.alternating import Alternating
from jaxdeform._deformation.descent import Solver, choose_adjoint
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.solve import deform
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._estimation.deformed import residual_of
from jaxdeform._estimation.poses import check_poses
from jaxdeform._result import Result, check_result


class ThesisEstimate(NamedTuple):
    """What `estimate_rigidity_thesis` returns.

    **Fields**

    - rigidity: the last value; its unit is length squared.
    - path: (evaluations,) rigidity at each evaluation.
    - history: (evaluations,) Frobenius norm of the difference at each.
    - result: how the search ended, a member of `Result`.
    """

    rigidity: float
    path: Float[np.ndarray, "evaluations"]
    history: Float[np.ndarray, "evaluations"]
    result: Result


def estimate_rigidity_thesis(
    problem: Problem,
    observed: ArrayLike,
    *,
    targets: ArrayLike | None = None,
    step_size: float = 0.01,
    threshold: float = 1e-3,
    start: float = 1e-6,
    solver: Solver = Alternating(steps=100),  # noqa: B008 (frozen)
    max_evaluations: int = 1000,
    throw: bool = False,
) -> ThesisEstimate:
    """Algorithm 1 of the thesis as written, for comparison: one rigidity, one pose.

    Adds ``step_size * |deformed - observed|_F`` until the relative change of rigidity is less than
    ``threshold``. It can only increase rigidity. It stops when a step is small compared to
    rigidity, whether the misfit is small or not. The thesis names neither step size nor threshold.

    **Arguments**: as `estimate_rigidity`; step_size (length), threshold and start as above.

    **Returns** a `ThesisEstimate`. **Raises** InputError as there.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.square()
        >>> problem = jd.precompute(mesh, [0, 1, 2, 6, 7, 8])
        >>> targets = jd.twist(mesh.vertices[problem.handles], 60.0, along="y")
        >>> pose = jd.deform(problem, targets, 0.5).vertices
        >>> bool(jd.estimate_rigidity_thesis(problem, pose, threshold=0.01).rigidity < 0.4)
        True
    """
    poses = check_poses(problem, observed, targets, None)
    if len(poses.targets) != 1:
        raise InputError(
            f"observed holds {len(poses.targets)} poses, but Algorithm 1 takes one: call it for "
            "each, and take the largest"
        )
    check_tolerance("step_size", step_size, positive=True)
    check_tolerance("threshold", threshold)
    check_tolerance("start", start, positive=True)
    check_count("max_evaluations", max_evaluations)
    check_flag("throw", throw)
    choose_adjoint(solver, None)
    rigidity, path, history = float(start), [], []
    result = Result.evaluation_limit
    for _ in range(max_evaluations):
        vertices = deform(problem, poses.targets[0], rigidity, solver=solver).vertices
        path.append(rigidity)
        history.append(float(np.linalg.norm(residual_of(poses, vertices[None]))))
        step = step_size * history[-1]
        if not np.isfinite(step):
            result = Result.fit_not_finite
            break
        rigidity += step
        if step / rigidity < threshold:
            result = Result.settled
            break
    out = ThesisEstimate(rigidity, np.array(path), np.array(history), result)
    return check_result(out, throw)
