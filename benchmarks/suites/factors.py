"""What may solve the global step, by size, for one deformation and for 32 together.

The dense inverse and CHOLMOD cross where ``DENSE_BELOW`` of the library says. Nested dissection is
for accelerators. Here it is timed on whatever device JAX runs on.
"""

from collections.abc import Callable

import igl
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from benchmarks import internals, workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric

DENSE_TO = 5200
"""Vertices up to which the dense inverse is timed."""


def run(quick: bool) -> Findings:
    out = []
    for size in (1000, 5000) if quick else (500, 1000, 2000, 5000, 50_000, 200_000):
        out += _factors(size)
    return Findings(out)


def _factors(size: int) -> list[Metric]:
    load = workloads.tube(size)
    matrix = internals.global_matrix(load.mesh)
    free = np.ones(load.mesh.n_vertices, bool)
    free[load.handles] = False
    ours = internals.factors(matrix, free, load.mesh.vertices, DENSE_TO)
    inner = matrix[free][:, free].tocsc()
    lu, peer = scipy.sparse.linalg.splu(inner), _libigl_factor(inner)
    solve = jax.jit(lambda factor, b: factor.solve(b))
    out = []
    for batch in (1, 32):
        right = np.random.default_rng(0).normal(size=(3 * batch, len(free)))
        right[:, ~free] = 0.0
        rows, columns = jnp.asarray(right), np.ascontiguousarray(right[:, free].T)
        none = np.zeros((0, 3 * batch))
        runs: dict[str, Callable[[], object]] = {
            name: lambda factor=factor, rows=rows: solve(factor, rows)
            for name, factor in ours.items()
        }
        runs["SuperLU through SciPy"] = lambda columns=columns: lu.solve(columns)
        runs["libigl"] = lambda columns=columns, none=none: igl.min_quad_with_fixed_solve(
            peer, -columns, none, none
        )
        _check_agreement(runs)
        for name, value in interleaved(runs, 5).items():
            label = f"one solve of {3 * batch} columns, {name}"
            out.append(Metric(label, load.name, 1e3 * value, "ms"))
    return out


def _libigl_factor(inner):
    """Return libigl's factor, made for a minimum without constraints."""
    data = igl.min_quad_with_fixed_data()
    no_constraints = scipy.sparse.csc_matrix((0, inner.shape[0]))
    igl.min_quad_with_fixed_precompute(inner, np.zeros(0, np.int64), no_constraints, True, data)
    return data


def _check_agreement(runs: dict[str, Callable[[], object]]) -> None:
    largest = {name: np.abs(np.asarray(run())).max() for name, run in runs.items()}
    values = list(largest.values())
    if not np.ptp(values) < 1e-9 * max(values):
        raise RuntimeError(f"the solvers disagree; largest entry of each: {largest}")
