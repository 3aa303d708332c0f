"""Is memory flat and the rate steady over a long run? ``python -m benchmarks.soak`` (Linux only).

20,000 small deformations in one process, of a problem made anew every 200; then 2,000 jobs of
``jaxdeform batch`` over a local cluster. Prints a table.
"""

import argparse
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
import psutil

import jaxdeform as jd
from benchmarks.harness import PROGRAM
from benchmarks.workloads import small_bar

PROBLEM_LASTS = 200
SAMPLES = 40
SETTLED = 0.25
"""The part of a run before it has compiled all it needs, which is left out."""

Sample = tuple[float, int, float]
"""Seconds since the start, deformations done, resident MiB."""


def one_process(count: int) -> Iterator[Sample]:
    """Deform so many times, by turns on problems of other handles, each time by other values."""
    mesh, random = small_bar(), np.random.default_rng(0)
    began, process = time.perf_counter(), psutil.Process()
    for turn in range(count):
        if turn % PROBLEM_LASTS == 0:
            low = random.uniform(0.04, 0.12)
            handles = jd.select.where(mesh, f"v < {low:.4f} or v > {1 - low:.4f}")
            problem = jd.precompute(mesh, handles)
            rest = mesh.vertices[handles.vertices]
        targets = jd.bend(rest, random.uniform(0.0, 90.0))
        out = jd.deform(problem, targets, 10.0 ** random.uniform(-1.0, 2.0))
        if not out.ok:
            raise RuntimeError(f"deformation {turn}: {out.result}")
        if (turn + 1) % max(1, count // SAMPLES) == 0:
            yield time.perf_counter() - began, turn + 1, process.memory_info().rss / 2**20


def cluster(count: int, workers: int) -> Iterator[Sample]:
    """Do so many jobs of a batch run; the memory is that of all its processes."""
    from jaxdeform._apps.batch import store, summary

    random = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jd.save_mesh(folder / "bar.off", small_bar())
        angles, rigidities = random.uniform(0, 90, count), 10 ** random.uniform(-1, 2, count)
        rows = [
            f"bar.off,v < 0.06,v > 0.94,z {angle:.3f},{rigidity:.4g}"
            for angle, rigidity in zip(angles, rigidities, strict=True)
        ]
        manifest = folder / "jobs.csv"
        manifest.write_text("\n".join(["mesh,fix,move,rotate,rigidity", *rows]) + "\n")
        run = folder / "run"
        words = ["batch", manifest, "-o", run, "--workers", str(workers)]
        began = time.perf_counter()
        child = psutil.Popen([PROGRAM, *words], stdout=subprocess.DEVNULL)
        jobs: list[Any] = []
        while child.poll() is None:
            time.sleep(2.0)
            root = store.find(str(run))
            if root is None or not root.attrs.get("complete"):
                continue
            jobs = jobs or store.jobs_of(root)
            done = summary.count(root, jobs).done
            try:
                family = [child, *child.children(recursive=True)]
                memory = sum(process.memory_info().rss for process in family)
            except psutil.Error:  # one has just ended
                continue
            if done == count:  # its workers are about to leave
                child.wait()
            elif done:
                yield time.perf_counter() - began, done, memory / 2**20
        if child.returncode:
            raise RuntimeError(f"jaxdeform batch ended with {child.returncode}")


def report(title: str, samples: list[Sample]) -> None:
    """Print the rate by quarters, and the slope of the memory after the first."""
    seconds, done, memory = map(np.array, zip(*samples, strict=True))
    late = done > SETTLED * done[-1]
    slope = np.polyfit(seconds[late], memory[late], 1)[0] * 3600
    edges = np.searchsorted(done, done[-1] * np.arange(1, 5) / 4)
    rates = [(done[b] - done[a]) / (seconds[b] - seconds[a]) for a, b in pairwise(edges)]
    mean = memory[late].mean()
    print(
        f"| {title} | {done[-1]:,} | {seconds[-1]:.0f} | {', '.join(f'{x:.1f}' for x in rates)} | "
        f"{mean:.0f} | {slope:+.1f} ({100 * slope / mean:+.2f} %) | "
        f"{100 * (memory[late][-1] / memory[late][0] - 1):+.2f} % |",
        flush=True,
    )


def main() -> None:
    """Run both, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--deformations", type=int, default=20_000)
    parser.add_argument("--jobs", type=int, default=2_000)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    print("| run | done | s | /s, by quarters from the second | MiB | MiB an hour | last / first |")
    print("|---|---|---|---|---|---|---|")
    runs: dict[str, Callable[[], Iterator[Sample]]] = {
        "one process": lambda: one_process(options.deformations),
        "batch run": lambda: cluster(options.jobs, options.workers),
    }
    for title, samples in runs.items():
        report(title, list(samples()))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
