"""The only file of the benchmarks that reaches below the public face of jaxdeform."""

import jax.numpy as jnp
import numpy as np

import jaxdeform as jd
from jaxdeform._deformation.covariance import stiffness
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._linalg.cholesky import Factor, dense_inverse, factorise
from jaxdeform._linalg.nested_dissection import dissected_factor


def local_step_inputs(problem: jd.Problem, vertices: np.ndarray):
    """Return C (3, 3, vertices) at given positions, and the principal moments (3, vertices)."""
    system = problem.system
    p = jnp.asarray(fill_up(vertices.T, problem.bucket))
    c, moments = system.covariance(p), system.principal_moments
    return c[..., : problem.n_vertices], moments[..., : problem.n_vertices]


def global_matrix(mesh: jd.Mesh):
    """Return A (vertices, vertices) of Eq. 4.5, sparse, for rings of 1."""
    return stiffness(jd.rings(mesh, 1))


def factors(matrix, free: np.ndarray, positions: np.ndarray, dense_to: int) -> dict[str, Factor]:
    """Return a factor of each kind of the free part.

    The dense inverse is made for at most ``dense_to`` vertices.
    """
    double = np.dtype(float)
    found: dict[str, Factor] = {
        "nested dissection": dissected_factor(matrix, free, positions, double),
        "CHOLMOD": factorise(matrix, free, double),
    }
    if len(free) <= dense_to:
        found["dense inverse"] = dense_inverse(matrix, free, double)
    return found
