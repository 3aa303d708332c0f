"""The first thing a person tries: 100 iterations on the cactus, precomputation included."""

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric


def run(quick: bool) -> Findings:
    load = workloads.cactus()
    load.start  # noqa: B018 (made here, so that no clock counts it)

    def ours():
        problem = jd.precompute(load.mesh, load.handles)
        rigidity = workloads.material(problem)
        solver = jd.Alternating(100)
        return jd.deform(problem, load.targets, rigidity, solver=solver, start=load.start)

    seconds = interleaved(
        {
            "libigl": lambda: load.run_libigl(load.libigl(100), 100),
            "ours": ours,
            "precompute": lambda: jd.precompute(load.mesh, load.handles),
            "libigl's": lambda: load.libigl(100),
        },
        3 if quick else 7,
    )
    ratio = seconds["ours"] / seconds["libigl"]
    name = "100 material iterations with precomputation / libigl's 100 rigid ones"
    return Findings(
        [
            Metric(name, load.name, ratio, "1", 1.0),
            Metric("precomputation", load.name, 1e3 * seconds["precompute"], "ms"),
            Metric("precomputation, libigl", load.name, 1e3 * seconds["libigl's"], "ms"),
        ]
    )
