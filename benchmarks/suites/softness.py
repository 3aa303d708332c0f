"""Evaluations by rigidity, with A as the first inverse Hessian and with the metric of the material.

Also what telling a minimum from a saddle costs, and what a coarse start saves, beside the
deformation.
"""

import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric
from benchmarks.workloads import Workload

NEAR = 1e-4
CONSTANTS = {10.0: None, 0.2: 45.0, 0.01: 30.0, 1e-3: 30.0}
"""Material constants, and the most evaluations that are aimed at."""


def run(quick: bool) -> Findings:
    loads = [workloads.bar(), workloads.cactus(), workloads.tube(5000)]
    if not quick:
        loads += [workloads.octopus(20_000), workloads.tube(20_000), workloads.tube(200_000)]
    out = []
    for load in loads:
        problem = jd.precompute(load.mesh, load.handles)
        for constant, target in CONSTANTS.items():
            if load.mesh.n_vertices < 100_000 or constant == 0.01:
                out += _evaluations(load, problem, constant, target)
    for load in loads[:3]:
        out.append(_cost_of_telling(load))
    for load in loads[1:5]:
        for constant in (10.0, 0.2):
            out += _coarse_start(load, constant)
    return Findings(out)


def _evaluations(load: Workload, problem: jd.Problem, constant: float, target) -> list[Metric]:
    rigidity, ways = jd.rigidity_from_material(problem, constant), {}
    for metric in ("stiffness", "material"):
        solver = jd.QuasiNewton(1e-9, 2000, metric=metric, leave_saddles=False)
        out = jd.deform(problem, load.targets, rigidity, start=load.start, solver=solver)
        ways[metric] = np.asarray(out.energy)
    least = min(energy[-1] for energy in ways.values())
    where = f"{load.name}, constant {constant:g}"
    return [
        Metric(
            f"evaluations to {NEAR:g} of the minimum, {metric}",
            where,
            _evaluations_to(energy, least),
            "evaluations",
            target if metric == "material" else None,
        )
        for metric, energy in ways.items()
    ]


def _evaluations_to(energy: np.ndarray, least: float) -> float:
    """Return how many evaluations it takes to come near the least energy."""
    near = energy <= least * (1 + NEAR)
    return float(np.argmax(near)) if near[-1] else np.inf


def _cost_of_telling(load: Workload) -> Metric:
    problem = jd.precompute(load.mesh, load.handles)
    rigidity = workloads.material(problem)
    runs = {
        str(leave): lambda leave=leave: jd.deform(
            problem,
            load.targets,
            rigidity,
            start=load.start,
            solver=jd.QuasiNewton(leave_saddles=leave),
        ).vertices.block_until_ready()
        for leave in (False, True)
    }
    seconds = interleaved(runs, 7)
    name = "telling a minimum from a saddle / the deformation"
    return Metric(name, load.name, seconds["True"] / seconds["False"] - 1.0, "1", 0.25)


def _coarse_start(load: Workload, constant: float) -> list[Metric]:
    """Descend to 1e-4 of the minimum from a coarse start, which counts, and from the usual one."""
    problem = jd.precompute(load.mesh, load.handles)
    rigidity, coarse = jd.rigidity_from_material(problem, constant), jd.coarsen(problem)

    def descend(from_coarse: bool, most: int, tolerance: float = 1e-9) -> jd.Solution:
        start = coarse.start(load.targets, rigidity) if from_coarse else None
        solver = jd.QuasiNewton(tolerance, most, leave_saddles=False)
        return jd.deform(problem, load.targets, rigidity, start=start, solver=solver)

    energy = {x: np.asarray(descend(x, 2000).energy) for x in (True, False)}
    steps = {x: int(_evaluations_to(e, e[-1])) for x, e in energy.items()}
    runs = {
        str(x): lambda x=x: descend(x, max(steps[x], 1), 0.0).vertices.block_until_ready()
        for x in (True, False)
    }
    seconds = interleaved(runs, 5)
    where = f"{load.name}, constant {constant:g}"
    end = float(energy[True][-1] / energy[False][-1])
    ratio = seconds["True"] / seconds["False"]
    return [
        Metric(f"evaluations to {NEAR:g}, coarse start", where, steps[True], "evaluations"),
        Metric(f"evaluations to {NEAR:g}, usual start", where, steps[False], "evaluations"),
        Metric("time with a coarse start / without", where, ratio, "1"),
        Metric("energy reached with a coarse start / without", where, end, "1"),
    ]
