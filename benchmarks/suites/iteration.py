"""One material iteration against one rigid iteration of libigl and of Open3D."""

import importlib
from collections.abc import Callable

import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric
from benchmarks.workloads import Workload

TARGETS = {"float64": 1.0, "float32": 0.7}


def run(quick: bool) -> Findings:
    loads = [workloads.cylinder()]
    if not quick:
        loads += [workloads.octopus(50_000), workloads.octopus(200_000)]
    out = []
    for load in loads:
        out += _iteration(load, steps=10 if load.mesh.n_vertices > 100_000 else 20)
    return Findings(out)


def _iteration(load: Workload, steps: int) -> list[Metric]:
    data = load.libigl(steps)
    runs: dict[str, Callable[[], object]] = {"libigl": lambda: load.run_libigl(data, steps)}
    runs |= {kind.__name__: _ours(load, steps, kind) for kind in (np.float64, np.float32)}
    open3d = _open3d(load, steps)
    if open3d is not None:
        runs["Open3D"] = open3d
    seconds = interleaved(runs, 3 if load.mesh.n_vertices > 100_000 else 5)
    per = {name: value / steps for name, value in seconds.items()}
    out = [
        Metric(
            f"material iteration / libigl's ARAP iteration, {kind}",
            load.name,
            per[kind] / per["libigl"],
            "1",
            target,
        )
        for kind, target in TARGETS.items()
    ]
    if open3d is not None:
        label = "material iteration / Open3D's ARAP iteration, float64"
        ratio, note = per["float64"] / per["Open3D"], "its call factors anew"
        out.append(Metric(label, load.name, ratio, "1", note=note))
    for name, value in per.items():
        out.append(Metric(f"time per iteration, {name}", load.name, 1e3 * value, "ms"))
    return out


def _ours(load: Workload, steps: int, kind: type) -> Callable[[], object]:
    """Return a run of our steps. It evaluates once more than it steps, for the last energy."""
    problem = jd.precompute(load.mesh, load.handles, cells=jd.rings(load.mesh, 1), dtype=kind)
    rigidity = np.asarray(workloads.material(problem))
    solver, start = jd.Alternating(steps), load.start.astype(kind)
    return lambda: jd.deform(problem, load.targets, rigidity, solver=solver, start=start)


def _open3d(load: Workload, steps: int) -> Callable[[], object] | None:
    try:
        open3d = importlib.import_module("open3d")  # the types pass with it and without
    except ImportError:
        return None
    vector = open3d.utility
    mesh = open3d.geometry.TriangleMesh(
        vector.Vector3dVector(np.array(load.mesh.vertices)),  # it takes no read-only array
        vector.Vector3iVector(load.mesh.faces.astype(np.int32)),
    )
    index = vector.IntVector(load.handles.astype(np.int32))
    points = vector.Vector3dVector(np.array(load.targets))
    return lambda: mesh.deform_as_rigid_as_possible(index, points, steps)
