"""Measure what one deformation costs; print it as JSON.

``python -m benchmarks.children.cost VERTICES RINGS LANES``: a tube of about so many vertices, cells
of so many rings, so many deformations at once.
"""

import json
import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402 (after x64)

import jaxdeform as jd  # noqa: E402
from benchmarks import harness, workloads  # noqa: E402

STEPS = 10
REPEATS = 3
WHOLE = 2**40
"""Memory, in bytes, that takes all members in one chunk."""


def main(vertices: int, rings: int, members: int) -> dict[str, float]:
    load = workloads.tube(vertices)
    seconds = []
    for turn in range(REPEATS):  # of another size each time, because factors are kept by content
        mesh = jd.Mesh(load.mesh.vertices * (1 + 1e-9 * turn), load.mesh.faces)
        began = time.perf_counter()
        problem = jd.precompute(mesh, load.handles, cells=jd.rings(mesh, rings))
        seconds.append(time.perf_counter() - began)
    rigidity = float(np.mean(workloads.material(problem))) * np.geomspace(0.5, 2.0, members)
    solver = jd.QuasiNewton(max_steps=STEPS, tolerance=0.0, leave_saddles=False)

    def run():
        return jd.deform_batch(problem, load.targets, rigidity, solver=solver, memory=WHOLE)

    times = []
    for turn in range(REPEATS + 1):  # the first one compiles
        began = time.perf_counter()
        out = jax.block_until_ready(run())
        if turn:
            times.append(time.perf_counter() - began)
    assert (np.asarray(out.steps) == STEPS).all()
    return {
        "vertices": mesh.n_vertices,
        "cell": problem.own_cells.membership.nnz / mesh.n_vertices,
        "members": members,
        "precompute": min(seconds),
        "step": min(times) / STEPS,
        "peak": harness.peak_gib(),
    }


if __name__ == "__main__":
    print(json.dumps(main(*map(int, sys.argv[1:]))))
