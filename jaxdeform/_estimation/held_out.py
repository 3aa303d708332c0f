"""Poses that were not fitted: how well does a rigidity predict them?"""

import numpy as np
from jaxtyping import Float

from jaxdeform._deformation.local_step import LocalStep
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.solve import deform
from jaxdeform._errors import ArrayLike
from jaxdeform._estimation.poses import check_poses


def prediction_errors(
    problem: Problem, observed: ArrayLike, rigidity: ArrayLike, local: LocalStep
) -> Float[np.ndarray, "poses"]:
    """Return how far predicted poses are from those observed, given where the handles went.

    Root mean square over the free vertices, of distances in diagonals of the bounding box. Each
    prediction starts without knowing its pose.
    """
    poses = check_poses(problem, observed, None, None)
    errors = []
    for targets, seen, counted in zip(poses.targets, poses.observed, poses.counted, strict=True):
        found = deform(problem, targets, rigidity, local=local)
        off = (np.asarray(found.vertices) - seen)[counted]
        errors.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return np.array(errors) / problem.mesh.diagonal
