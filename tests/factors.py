"""What tests share: a matrix, its factor, and a solve."""

import jax
import numpy as np
import scipy.sparse as sp

from jaxdeform._linalg.cholesky import HostCholesky, factorise

DOUBLE, SINGLE = np.dtype(np.float64), np.dtype(np.float32)


def graded(free_from: int = 40, seed: int = 0) -> tuple[sp.csr_matrix, np.ndarray]:
    """Return a matrix of 1,500 unknowns, whose values depend on the seed, and which are free."""
    n = 1500
    i = np.concatenate([np.arange(n - 1), np.arange(n - 40)])
    j = np.concatenate([np.arange(1, n), np.arange(40, n)])
    weights = np.exp(np.random.default_rng(seed).normal(size=len(i)))
    graph = sp.coo_matrix((weights, (i, j)), shape=(n, n))
    graph = graph + graph.T
    matrix = sp.csr_matrix(sp.diags(np.asarray(graph.sum(axis=1)).ravel() + 1e-3) - graph)
    free = np.ones(n, bool)
    free[:free_from] = False
    return matrix, free


def made(*arguments, dtype=DOUBLE, **settings) -> HostCholesky:
    matrix, free = graded(*arguments, **settings)
    factor = factorise(matrix, free, dtype, positions=np.zeros((len(free), 3)))
    assert isinstance(factor, HostCholesky)
    return factor


@jax.jit
def solve(factor, right):
    return factor.solve(right)
