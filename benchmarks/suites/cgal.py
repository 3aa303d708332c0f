"""CGAL's ARAP as a peer: an iteration on one CPU, and the time to come near the minimum.

Nothing is measured where CGAL cannot be compiled (libcgal-dev and g++ bring what it takes). CGAL
takes no start: it begins with all rotations the identity. So ours and libigl begin where its first
iteration ends, which is where these rotations lead.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.cgal import Cgal, program
from benchmarks.harness import interleaved, run_child
from benchmarks.metrics import Findings, Metric
from benchmarks.suites.convergence import Case, libigl_by_tens, our_descent, peer_descent
from benchmarks.workloads import Workload
from jaxdeform._linalg.factor_cache import factors

CONSTANTS = (10.0, 0.2, 0.01)


def run(quick: bool) -> Findings:
    if program() is None:
        return Findings([])
    out = []
    for name in ("bar", "cylinder", "cactus", "octopus")[: 2 if quick else None]:
        out += _iteration(name)
    for load in [workloads.cactus()] if quick else [workloads.cylinder(), workloads.cactus()]:
        out += _descent(load)
    return Findings(out)


def _iteration(name: str) -> list[Metric]:
    steps = 10 if name == "octopus" else 50
    seconds = run_child("one_thread", name, steps, 5)
    label = "material iteration / CGAL's ARAP iteration, one CPU"
    times = [
        Metric(f"time per iteration on one CPU, {key}", name, 1e3 * value, "ms")
        for key, value in seconds.items()
    ]
    return [Metric(label, name, seconds["jaxdeform"] / seconds["CGAL"], "1", 1.0), *times]


def _descent(load: Workload) -> list[Metric]:
    rigid = jd.precompute(load.mesh, load.handles, cells=jd.spokes(load.mesh))
    problem = jd.precompute(load.mesh, load.handles)
    constants = {x: jd.rigidity_from_material(problem, x) for x in CONSTANTS}
    cases = [Case(f"constant {x:g}", problem, r, jd.Newton(), 0.05) for x, r in constants.items()]
    with Cgal(load.mesh, load.handles, load.targets) as cgal:
        cgal.deform(1)
        load = replace(load, other_start=cgal.vertices())
        cgal.reset()

        def by_tens() -> np.ndarray:
            cgal.deform(10)
            return cgal.vertices()

        peer = peer_descent(load, rigid, by_tens)

        def theirs() -> None:
            cgal.reset()
            cgal.deform(peer.steps)

        libigl = peer_descent(load, rigid, libigl_by_tens(load))
        data = load.libigl(libigl.steps)
        runs: dict[str, Callable[[], object]] = {"CGAL": theirs}
        runs["libigl"] = lambda: load.run_libigl(data, libigl.steps)
        for case in cases:
            runs[case.name] = our_descent(load, case).run
            runs[f"{case.name} and factors"] = _with_factors(load, case)
        seconds = interleaved(runs, 5)
        prepared = seconds["CGAL"] + cgal.seconds_to_prepare
    out = [
        Metric(f"time to within 1e-4, {name}, from CGAL's start", load.name, seconds[name], "s",
               note=descent.note)
        for name, descent in {"CGAL": peer, "libigl": libigl}.items()
    ]  # fmt: skip
    for case in cases:
        label = f"time to within 1e-4 of the minimum, {case.name} / CGAL's rigid ARAP"
        ratio = seconds[case.name] / seconds["CGAL"]
        out.append(Metric(label, load.name, ratio, "1", case.target))
        ratio = seconds[f"{case.name} and factors"] / prepared
        out.append(Metric(f"{label}, both with precomputation", load.name, ratio, "1", 0.1))
    return out


def _with_factors(load: Workload, case: Case) -> Callable[[], object]:
    """Return a run that precomputes, and makes the factors of both metrics, each time."""
    descent = our_descent(load, case)

    def run() -> object:
        factors.clear()
        problem = jd.precompute(load.mesh, load.handles)
        return descent.of(problem)

    return run
