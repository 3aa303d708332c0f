"""The prior of a smooth field: differences of log rigidity along the edges cost something."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._deformation.problem import Problem
from jaxdeform._linalg.buckets import bucket, enlarge, fill_up
from jaxdeform._linalg.cholesky import Factor, factorise
from jaxdeform._mesh.laplacian import cotangent_weights, graph_laplacian, lifted_weights

# Conjugate gradients of one Gauss-Newton step, which need not be exact: 1e-2 and 60 steps take
# three times as long for the same field.
_CG_TOLERANCE, _CG_STEPS = 3e-2, 30
# Vertices whose variances are solved for together.
_TOGETHER = 256
# Constants cost nothing under the Laplacian; where it must be inverted, they cost a little.
_SHIFT = 1e-2
# Total variation takes differences of log rigidity below this for none.
FLAT = 1e-2


class Prior(NamedTuple):
    """The cotangent Laplacian L of log rigidity t, as a sum over the edges.

    ``t^T L t`` is the integral of |grad t|^2 over the surface: a pure number. All arrays have the
    size of the problem's bucket, so that meshes of about one size share the compiled code: behind
    the last vertex are some that no edge touches, behind the last edge some of weight 0.
    """

    root: Float[Array, "edges"]
    """Square roots of the edge weights."""
    edges: Int[Array, "edges 2"]
    inside: Bool[Array, "vertices"]
    """False for those behind the last vertex of the mesh."""
    factor: Factor
    """Of L, made definite: the preconditioner."""

    @classmethod
    def of(cls, problem: Problem, near: Float[np.ndarray, "vertices"] | None = None) -> "Prior":
        """Set up the prior of a problem's mesh.

        With a field, that of total variation near it: each square is divided by the present size of
        its difference in units of `FLAT`, or by 1 where that is less (reweighted least squares).
        """
        mesh = problem.mesh
        # Negative weights would reward differences.
        weights = lifted_weights(cotangent_weights(mesh))
        if near is not None:
            i, j = mesh.edges.T
            weights = weights * FLAT / np.maximum(np.abs(near[i] - near[j]), FLAT)
        size = problem.bucket
        laplacian = enlarge(graph_laplacian(mesh.edges, weights, mesh.n_vertices), size)
        shifted = laplacian + _SHIFT * sp.identity(size)
        positions = fill_up(mesh.vertices.T, size).T
        factor = factorise(shifted.tocsr(), np.ones(size, bool), problem.dtype, positions=positions)
        most = bucket(max(len(weights), 3 * size))  # closed meshes have 3 edges a vertex
        root = fill_up(np.sqrt(weights).astype(problem.dtype), most)
        edges = fill_up(mesh.edges.T.astype(np.int32), most).T
        inside = fill_up(np.ones(mesh.n_vertices, bool), size)
        root, edges, inside = jax.device_put((root, edges, inside))
        return cls(root, edges, inside, factor)

    @property
    def n_vertices(self) -> int:
        """Number of vertices of the mesh."""
        return int(np.count_nonzero(self.inside))

    def differences(self, theta: Float[Array, "vertices"]) -> Float[Array, "edges"]:
        """Return weighted differences: the sum of their squares is the prior."""
        return self.root * (theta[self.edges[:, 0]] - theta[self.edges[:, 1]])

    def value(self, theta: Float[Array, "vertices"]) -> float:
        """Return what a field costs."""
        return float(jnp.sum(self.differences(theta) ** 2))

    def product(
        self, vectors: Float[Array, "vertices columns"]
    ) -> Float[Array, "vertices columns"]:
        """Return L, made definite, times vectors."""
        i, j = self.edges.T
        flow = (self.root**2)[:, None] * (vectors[i] - vectors[j])
        return (_SHIFT * vectors).at[i].add(flow).at[j].add(-flow)

    def variances(self) -> Float[np.ndarray, "vertices"]:
        """Return the diagonal of the inverse of L, made definite: one solve for each vertex."""
        n, unknowns = self.n_vertices, np.arange(len(self.inside))
        found = np.empty(n)
        for first in range(0, n, _TOGETHER):
            at = np.arange(first, first + _TOGETHER)
            unit = (unknowns == at[:, None]).astype(self.root.dtype)
            inside = at[at < n]
            found[inside] = np.asarray(self.factor.solve(jnp.asarray(unit)))[inside - first, inside]
        return found


class WithPrior(eqx.Module):
    """The derivative of the residual with the prior below it."""

    data: lx.FunctionLinearOperator
    prior: Prior
    weight: Float[Array, ""]

    def mv(self, vector):
        """Return the product with a change of log rigidity."""
        return self.data.mv(vector), jnp.sqrt(self.weight) * self.prior.differences(vector)


class Solve(eqx.Module):
    """Solves for the Gauss-Newton step by conjugate gradients, preconditioned with the prior."""

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
