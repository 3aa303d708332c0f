"""Do the jobs of a manifest in a plain loop, as one would write it; print the seconds.

``python -m benchmarks.children.job_loop MANIFEST``: all jobs are on one mesh with the same handles.
"""

import csv
import json
import sys
import time
from pathlib import Path

began = time.perf_counter()

import jax  # noqa: E402 (after the clock)

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402 (after x64)

import jaxdeform as jd  # noqa: E402


def main(manifest: str) -> float:
    jd.enable_compilation_cache()
    with open(manifest, newline="") as file:
        jobs = list(csv.DictReader(file))
    mesh = jd.load_mesh(Path(manifest).parent / jobs[0]["mesh"])
    fixed, moved = (jd.select.where(mesh, jobs[0][name]) for name in ("fix", "move"))
    handles = fixed | moved
    problem, rest = jd.precompute(mesh, handles), mesh.vertices[handles.vertices]
    turned = np.isin(handles.vertices, moved.vertices)[:, None]
    poses = []
    for job in jobs:
        axis, degrees = job["rotate"].split()
        center = mesh.vertices[moved.vertices].mean(axis=0)
        targets = np.where(turned, jd.rotate(rest, float(degrees), axis=axis, center=center), rest)
        out = jd.deform(problem, targets, float(job["rigidity"]))
        if not out.ok:
            raise RuntimeError(f"job {job}: {out.result}")
        poses.append(np.asarray(out.vertices))
    return time.perf_counter() - began


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1])))
