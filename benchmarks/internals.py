"""The only file of the benchmarks that reaches below the public face of jaxdeform."""

import jax.numpy as jnp
import numpy as np

import jaxdeform as jd
from jaxdeform import global_step
from jaxdeform.energy import stiffness
from jaxdeform.global_step import Factor, factorise
from jaxdeform.local_step import LocalStep
from jaxdeform.nested_dissection import dissected_factor

__all__ = ["Factor", "LocalStep", "factors", "global_matrix", "local_step_inputs"]


def local_step_inputs(problem: jd.Problem, vertices: np.ndarray):
    """Return C (3, 3, vertices) at given positions, and the principal moments (3, vertices)."""
    return problem.system.scatter(jnp.asarray(vertices.T)), problem.system.b


def global_matrix(mesh: jd.Mesh):
    """Return A (vertices, vertices) of Eq. 4.5, sparse, for rings of 1."""
    return stiffness(jd.rings(mesh, 1))


def factors(
    matrix, free: np.ndarray, positions: np.ndarray, dense_to: int
) -> dict[str, tuple[Factor, object]]:
    """Return a factor of each kind of the free part, with what must be kept alive for it.

    The dense inverse is made for at most ``dense_to`` vertices.
    """
    double = np.dtype(float)
    found: dict[str, tuple[Factor, object]] = {
        "nested dissection": (dissected_factor(matrix, free, positions, double), None)
    }
    limit = global_step.DENSE_BELOW
    try:
        # No positions are given. With them factorise prefers nested dissection on an accelerator.
        for name, global_step.DENSE_BELOW in (("CHOLMOD", 0), ("dense inverse", dense_to)):
            if name == "CHOLMOD" or len(free) <= dense_to:
                found[name] = factorise(matrix, free, double)
    finally:
        global_step.DENSE_BELOW = limit
    return found
