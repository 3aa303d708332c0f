"""A hand pulls an arm of the cactus: frames a second, and what other handles compile."""

import time

import jax
import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import compilations
from benchmarks.metrics import Findings, Metric
from benchmarks.workloads import Workload

SOLVER = jd.QuasiNewton(max_steps=10, tolerance=1e-5, leave_saddles=False)


def run(quick: bool) -> Findings:
    load = workloads.cactus()
    problem = jd.precompute(load.mesh, load.handles)
    rigidity = np.asarray(workloads.material(problem))
    mean, worst = _drag(load, problem, rigidity, frames=20 if quick else 60)
    compilations = _compilations_of_other_handles(load, rigidity)
    return Findings(
        [
            Metric("frames a second while dragging", load.name, 1 / mean, "/s", 20, True),
            Metric("slowest frame", load.name, 1e3 * worst, "ms"),
            Metric("recompilations for new handle sets", load.name, compilations, "", 0),
        ]
    )


def _drag(load: Workload, problem: jd.Problem, rigidity, frames: int) -> tuple[float, float]:
    """Return the mean and the largest seconds of a frame. Each starts from the one before."""
    rest = load.mesh.vertices[load.handles]
    moving = load.targets - rest
    path = [rest + moving * (k + 1) / frames for k in range(frames)]
    solution = jd.deform(problem, load.targets, rigidity, solver=SOLVER, start=load.start)
    jax.block_until_ready(solution)
    worst, began = 0.0, time.perf_counter()
    for targets in path:
        frame = time.perf_counter()
        solution = jd.deform(problem, targets, rigidity, solver=SOLVER, start=solution.vertices)
        jax.block_until_ready(solution)
        worst = max(worst, time.perf_counter() - frame)
    return (time.perf_counter() - began) / frames, worst


def _compilations_of_other_handles(load: Workload, rigidity) -> int:
    """Return how often XLA compiles when two other sets of handles are deformed."""
    with compilations() as compiled:
        for foot in (0.2, 0.4):
            y = load.mesh.vertices[:, 1]
            handles = np.flatnonzero((y < foot) | (y > 4.2))
            other = jd.precompute(load.mesh, handles)
            targets = load.mesh.vertices[handles] + 0.1
            jd.deform(other, targets, rigidity, solver=SOLVER, start=load.start)
    return len(compiled)
