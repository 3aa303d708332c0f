"""Runs that outgrow one call: what ``deform_batch`` and ``jaxdeform batch`` cost beside a loop."""

import subprocess
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import PROGRAM, interleaved, run_child
from benchmarks.metrics import Findings, Metric


def run(quick: bool) -> Findings:
    sizes = [(workloads.bar(), 64)] if quick else _sizes()
    found = [metric for size in sizes for metric in _beside_a_loop(*size)]
    found.append(_overhead(20 if quick else 500))
    found.append(_resume(200 if quick else 10_000))
    if not quick:
        found += _scaling()
    return Findings(found)


def _sizes() -> list[tuple[workloads.Workload, int]]:
    return [(workloads.bar(), 1024), (workloads.tube(5_000), 64), (workloads.tube(50_000), 8)]


def _beside_a_loop(load: workloads.Workload, count: int) -> list[Metric]:
    """Return the rate of ``deform_batch`` over those of a loop, and of the better of two ways."""
    problem = jd.precompute(load.mesh, load.handles)
    rigidities = np.geomspace(0.05, 50.0, count)
    many = jax.jit(jax.vmap(lambda r: jd.deform(problem, load.targets, r).vertices))
    each = max(1, count // 32)
    seconds = interleaved(
        {
            "deform_batch": lambda: jd.deform_batch(problem, load.targets, rigidities).vertices,
            "vmap": lambda: many(rigidities),
            # A part of them, because they are many.
            "loop": lambda: [jd.deform(problem, load.targets, r) for r in rigidities[::each]],
        },
        3,
    )
    loop = seconds["loop"] * count / len(rigidities[::each])
    best = min(loop, seconds["vmap"])
    name = f"{count} deformations, deform_batch: rate"
    return [
        Metric(f"{name} / that of a loop", load.name, loop / seconds["deform_batch"], "1", 1.5,
               more_is_better=True),
        Metric(f"{name} / that of the better of loop and vmap", load.name,
               best / seconds["deform_batch"], "1", 1.0, more_is_better=True),
    ]  # fmt: skip


def _manifest(folder: Path, mesh: jd.Mesh, count: int) -> Path:
    jd.save_mesh(folder / "mesh.ply", mesh)
    rows = [f"mesh.ply,v < 0.04,v > 0.96,z 30,{x:.6g}" for x in np.geomspace(0.05, 50.0, count)]
    path = folder / "jobs.csv"
    path.write_text("\n".join(["mesh,fix,move,rotate,rigidity", *rows]) + "\n")
    return path


def _batch(manifest: Path, run: Path, workers: int = 1) -> float:
    began = time.perf_counter()
    command = [PROGRAM, "batch", manifest, "-o", run, "--workers", str(workers)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def _overhead(count: int) -> Metric:
    with tempfile.TemporaryDirectory() as name:
        folder, load = Path(name), workloads.tube(5_000)
        manifest = _manifest(folder, load.mesh, count)
        run_child("job_loop", manifest)  # compiles
        loop, batch = run_child("job_loop", manifest), _batch(manifest, folder / "run")
    what = f"{count} jobs, jaxdeform batch with one worker / a loop, whole processes"
    return Metric(what, load.name, batch / loop, "1", 1.15, note=f"{batch:.0f} and {loop:.0f} s")


def _resume(count: int) -> Metric:
    """Time the command on a run that is finished, whose results are made up."""
    from jaxdeform._apps.batch import store
    from jaxdeform._apps.batch.manifest import read_manifest
    from jaxdeform._apps.batch.work import Done

    with tempfile.TemporaryDirectory() as name:
        folder, mesh = Path(name), workloads.fine_tube(100)
        manifest = _manifest(folder, mesh, count)
        jobs = read_manifest(manifest)
        root = store.make(str(folder / "run"), jobs)
        n = mesh.n_vertices
        one = Done(mesh.vertices, np.ones(n), 1.0, np.nan, 5, 0, "converged", 0.1)
        for block, _ in store.blocks(root, jobs):
            store.write(root, block, [one] * len(block.jobs))
        _batch(manifest, folder / "run")  # writes the summary, which ends a run
        seconds = _batch(manifest, folder / "run")
    return Metric(
        f"resume of a finished run of {count:,} jobs", f"tube, {n} vertices", seconds, "s", 5.0
    )


def _scaling() -> list[Metric]:
    """Time the same jobs, then as many jobs a worker, with 1, 2 and 4 workers."""
    load, count, found = workloads.tube(5_000), 64, []
    with tempfile.TemporaryDirectory() as name:
        for workers in (1, 2, 4):
            folder = Path(name, str(workers))
            folder.mkdir()
            strong = _batch(_manifest(folder, load.mesh, count), folder / "a", workers)
            weak = _batch(_manifest(folder, load.mesh, count * workers // 2), folder / "b", workers)
            found += [
                Metric(f"{count} jobs, {workers} workers", load.name, strong, "s"),
                Metric(f"{count // 2} jobs a worker, {workers} workers", load.name, weak, "s"),
            ]
    return found
