"""What the device that JAX runs on takes, beside the CPU of its host, and whether they agree.

Where JAX has no accelerator there is nothing to compare: the suite says so and finds nothing.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import internals, workloads
from benchmarks.children import one_device
from benchmarks.harness import interleaved, run_child
from benchmarks.metrics import Findings, Metric

TIMED = (
    "one deformation",
    "one alternating iteration",
    "value and gradient",
    "one of a batch",
    "one of a batch, one by one",
)
APART = {"float64": 1e-8, "float32": 1e-3}
"""How far vertices may differ, in diagonals of the mesh."""
CHAIN = 20
"""Solves in one program, so that no single launch is timed."""


def run(quick: bool) -> Findings:
    if jax.default_backend() == "cpu":
        print("accelerator: skipped, JAX runs on the CPU here", file=sys.stderr)
        return Findings([])
    loads = {"bar": 64} if quick else {"bar": 1024, "cylinder": 0, "octopus": 0}
    out = []
    for precision in APART:
        for load, batch in loads.items():
            out += _beside_host(load, precision, batch, repeats=3 if quick else 5)
    for size in (1000,) if quick else (1000, 5000, 10_000):
        out += _factors(size)
    return Findings(out)


def _beside_host(load: str, precision: str, batch: int, repeats: int) -> list[Metric]:
    """Return the metrics of one workload: what the device takes, as a fraction of the host's."""
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder, f"{where}.npz")) for where in ("device", "host")]
        settings = load, precision, batch, repeats
        ours = one_device.main(*settings, files[0])
        host = run_child("one_device", *settings, files[1], environment={"JAX_PLATFORMS": "cpu"})
        ends = [dict(np.load(file)) for file in files]
    where = f"{load}, {precision}"
    out = []
    for name in (name for name in TIMED if name in ours):
        whole = name == "one deformation"
        note = f"{ours['steps']:.0f} steps, host {host['steps']:.0f}" if whole else ""
        value, ratio = 1e3 * ours[name], ours[name] / host[name]
        out.append(Metric(f"{name}, device", where, value, "ms", note=note))
        out.append(Metric(f"{name}, device / host", where, ratio, "1", 1.0))
    for name in ("precomputation", "first call"):
        out.append(Metric(f"{name}, device", where, ours[name], "s"))
        out.append(Metric(f"{name}, host", where, host[name], "s"))
    return out + _agreement(where, ends, APART[precision]) + _faults(where, ours)


def _agreement(where: str, ends: list[dict[str, Any]], most: float) -> list[Metric]:
    """Return how far the device's vertices and energy are from the host's."""
    ours, host = (end["vertices"].astype(float) for end in ends)
    diagonal = float(np.linalg.norm(np.ptp(host, axis=0)))
    # NaN is no distance: it must not look reached.
    apart = float(np.nan_to_num(np.abs(ours - host).max() / diagonal, nan=np.inf))
    energies = [float(end["energy"]) for end in ends]
    return [
        Metric("vertices, device and host apart, in diagonals", where, apart, "", most),
        Metric("energy, device / host - 1", where, energies[0] / energies[1] - 1, ""),
    ]


def _faults(where: str, ours: dict[str, float]) -> list[Metric]:
    """Return what did not converge, and how far a batch is from its members alone."""
    names = {"not ok": "deformation did not converge", "batch not ok": "of the batch, the same"}
    out = [Metric(names[x], where, ours[x], "", 0) for x in names if x in ours]
    if "batch apart" in ours:
        name = "vertices, batch and one by one apart, in diagonals"
        out.append(Metric(name, where, ours["batch apart"], ""))
    return out


def _factors(size: int) -> list[Metric]:
    """Return what a solve of three columns takes with each factor that stays on the device."""
    load = workloads.tube(size)
    free = np.ones(load.mesh.n_vertices, bool)
    free[load.handles] = False
    matrix = internals.global_matrix(load.mesh)
    found = internals.factors(matrix, free, load.mesh.vertices, dense_to=size + 100)
    rows = jnp.asarray(np.random.default_rng(0).normal(size=(3, len(free))))
    chain = jax.jit(
        lambda factor, b: jax.lax.fori_loop(0, CHAIN, lambda _, x: factor.solve(x) + b, b)
    )
    runs: dict[str, Callable[[], object]] = {
        name: lambda factor=found[name]: chain(factor, rows)
        for name in ("nested dissection", "dense inverse")
    }
    return [
        Metric(f"one solve of 3 columns, {name}, device", load.name, 1e3 * spent / CHAIN, "ms")
        for name, spent in interleaved(runs, 5).items()
    ]
