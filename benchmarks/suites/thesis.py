"""The thesis's gradient descent, vertex by vertex, against ours, to the same energy."""

import time

import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric
from benchmarks.thesis import ThesisDeformation
from benchmarks.workloads import Workload


def run(quick: bool) -> Findings:
    out = _against_thesis(workloads.bar(), rigidity=1.0, steps=100)
    if not quick:
        out += _against_thesis(workloads.cylinder(), rigidity=0.05, steps=8)
    return Findings(out)


def _against_thesis(load: Workload, rigidity: float, steps: int) -> list[Metric]:
    problem = jd.precompute(load.mesh, load.handles)
    theirs = ThesisDeformation(load.mesh, load.handles, jd.rings(load.mesh, 1))
    began = time.perf_counter()
    *_, p = theirs.iterate(load.targets, load.start, rigidity, steps)
    slow = time.perf_counter() - began
    reached = load.reduced_energy(problem, p, rigidity, jd.Newton())
    energy = np.asarray(jd.deform(problem, load.targets, rigidity, start=load.start).energy)
    needed = int(np.flatnonzero(energy <= reached)[0])
    solver = jd.QuasiNewton(max_steps=max(1, needed), tolerance=0.0, leave_saddles=False)

    def ours():
        return jd.deform(problem, load.targets, rigidity, solver=solver, start=load.start)

    # 40 repeats: a run takes a few milliseconds, and the first dozen find cold caches.
    fast = interleaved({"ours": ours}, 40)["ours"]
    label = "thesis's way / ours, same energy reached"
    note = f"rigidity {rigidity:g}, its {steps} iterations"
    return [
        Metric(label, load.name, slow / fast, "1", 1000, True, tolerance=0.4, note=note),
        Metric("time, the thesis's way", load.name, slow, "s"),
        Metric("time, ours to the same energy", load.name, 1e3 * fast, "ms"),
    ]
