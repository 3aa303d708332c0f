"""Time iterations of one workload on one CPU, ours and those of CGAL and libigl, in turns.

``python -m benchmarks.children.one_thread WORKLOAD STEPS REPEATS`` prints the seconds an iteration
by name.
"""

import json
import os
import sys

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX starts its threads

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jaxdeform as jd  # noqa: E402
from benchmarks import workloads  # noqa: E402
from benchmarks.cgal import Cgal  # noqa: E402
from benchmarks.children.one_device import LOADS  # noqa: E402
from benchmarks.harness import interleaved  # noqa: E402


def main(name: str, steps: int, repeats: int) -> dict[str, float]:
    load = LOADS[name]()
    problem = jd.precompute(load.mesh, load.handles)
    rigidity, solver = workloads.material(problem), jd.Alternating(steps)
    data = load.libigl(steps)
    with Cgal(load.mesh, load.handles, load.targets) as cgal:
        runs = {
            "jaxdeform": lambda: jd.deform(
                problem, load.targets, rigidity, solver=solver, start=load.start
            ),
            "CGAL": lambda: cgal.deform(steps),
            "libigl": lambda: load.run_libigl(data, steps),
        }
        return {key: value / steps for key, value in interleaved(runs, repeats).items()}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
