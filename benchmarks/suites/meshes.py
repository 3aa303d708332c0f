"""Meshes never seen, of one size: what the first deformation of each costs beside the second."""

import time

import jax
import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import compilations
from benchmarks.metrics import Findings, Metric
from benchmarks.workloads import Workload

# Their arrays have 5,128 entries.
SIZES = range(4500, 5100, 60)


def run(quick: bool) -> Findings:
    loads = [workloads.tube(size) for size in list(SIZES)[: 4 if quick else None]]
    _deform(loads[0])
    with compilations() as compiled:
        seconds = np.array([[_deform(load), _deform(load)] for load in loads[1:]])
    first, second = np.median(seconds, axis=0)
    name = f"tubes, {loads[0].mesh.n_vertices:,} to {loads[-1].mesh.n_vertices:,} vertices"
    return Findings(
        [
            Metric("mesh never seen, precomputation and deformation", name, first, "s"),
            Metric("mesh never seen / the same again", name, first / second, "1", 1.3),
            Metric("recompilations for new meshes of one size", name, len(compiled), "", 0),
        ]
    )


def _deform(load: Workload) -> float:
    """Return the seconds of precomputation and deformation, from vertices and faces."""
    mesh = jd.Mesh(load.mesh.vertices, load.mesh.faces)
    began = time.perf_counter()
    problem = jd.precompute(mesh, load.handles)
    jax.block_until_ready(jd.deform(problem, load.targets, workloads.material(problem)))
    return time.perf_counter() - began
