"""Peak resident memory of a process that does one thing (Linux only)."""

import sys

from benchmarks.harness import run_child
from benchmarks.metrics import Findings, Metric


def run(quick: bool) -> Findings:
    if sys.platform != "linux":
        return Findings([])
    if quick:
        return Findings(_of_deformation("tube", 50_000, 20, limit=2.0))
    return Findings(
        _of_deformation("octopus", 50_000, 100, limit=2.0)
        + _of_deformation("tube", 1_000_000, 20, limit=8.0)
        + _of_gradient("Implicit", target=1.05)
        + _of_gradient("Unrolled", target=None)
    )


def _of_deformation(maker: str, size: int, steps: int, limit: float) -> list[Metric]:
    before, after, peak = run_child("deformation_memory", maker, size, steps)
    name = f"{maker}, {size:,} vertices"
    return [
        Metric(f"peak memory, precomputation and {steps} steps", name, peak, "GiB", limit),
        Metric("precomputation", name, before, "s"),
        Metric(f"{steps} steps, compilation included", name, after, "s"),
    ]


def _of_gradient(adjoint: str, target: float | None) -> list[Metric]:
    few, many = (run_child("gradient_memory", adjoint, steps) for steps in (50, 400))
    name = f"peak memory of value and gradient, {adjoint}, 400 steps / 50 steps"
    return [
        Metric(name, "tube, 20,000 vertices", many / few, "1", target),
        Metric(f"peak memory, {adjoint}, 400 steps", "tube", many, "GiB"),
    ]
