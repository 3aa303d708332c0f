"""Precompute and deform one workload; print seconds of both and the peak memory in GiB.

``python -m benchmarks.children.deformation_memory MAKER VERTICES STEPS``
"""

import json
import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import jaxdeform as jd  # noqa: E402 (after x64)
from benchmarks import harness, workloads  # noqa: E402


def main(maker: str, vertices: int, steps: int) -> list[float]:
    load = getattr(workloads, maker)(vertices)
    began = time.perf_counter()
    problem = jd.precompute(load.mesh, load.handles)
    ready = time.perf_counter()
    rigidity = workloads.material(problem)
    solver, start = jd.Alternating(steps), load.mesh.vertices
    out = jd.deform(problem, load.targets, rigidity, solver=solver, start=start)
    jax.block_until_ready(out)
    done = time.perf_counter()
    if not bool(out.ok):
        raise RuntimeError(str(out.result))
    if not float(out.energy[-1]) < float(out.energy[0]):
        raise RuntimeError(f"the energy did not fall: {out.energy[0]} to {out.energy[-1]}")
    return [ready - began, done - ready, harness.peak_gib()]


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
