"""Time per iteration against the number of vertices."""

import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric

STEPS = 5


def run(quick: bool) -> Findings:
    sizes = (5_000, 20_000) if quick else (5_000, 20_000, 50_000, 200_000, 500_000)
    counts, ours, theirs = [], [], []
    for size in sizes:
        count, one, other = _per_iteration(size)
        counts.append(count)
        ours.append(one)
        theirs.append(other)
    exponent = float(np.polyfit(np.log(counts), np.log(ours), 1)[0])
    span = f"tube, {counts[0]:,} to {counts[-1]:,} vertices"
    metrics = [Metric("exponent of time per iteration", span, exponent, "1", 1.15, tolerance=0.1)]
    metrics += [
        Metric("time per iteration", f"tube, {n:,} vertices", 1e3 * t, "ms")
        for n, t in zip(counts, ours, strict=True)
    ]
    lines = {"jaxdeform, material": (counts, ours), "libigl, rigid": (counts, theirs)}
    return Findings(metrics, {"size": lines})


def _per_iteration(size: int) -> tuple[int, float, float]:
    """Return the vertices of a tube, and the seconds an iteration takes us and libigl."""
    load = workloads.tube(size)
    data = load.libigl(STEPS)
    problem = jd.precompute(load.mesh, load.handles)
    rigidity = np.asarray(workloads.material(problem))
    start, solver = load.mesh.vertices, jd.Alternating(STEPS)
    seconds = interleaved(
        {
            "ours": lambda: jd.deform(problem, load.targets, rigidity, solver=solver, start=start),
            "libigl": lambda: load.run_libigl(data, STEPS, start=start),
        },
        3,
    )
    return load.mesh.n_vertices, seconds["ours"] / STEPS, seconds["libigl"] / STEPS
