"""One side of ``benchmarks.compare``: runs workloads of one version of jaxdeform when told to.

It is run as a file and PYTHONPATH names the tree, so that it imports jaxdeform from there and
nothing else from either tree. Its workloads are arrays that the parent wrote: both sides get the
same. It reads one JSON command a line and answers each with one JSON line:

    {"do": "prepare", "name": NAME, "kind": KIND, "file": NPZ, ...}  builds, compiles, runs once
    {"do": "run", "name": NAME}                                      {"seconds": ..., "note": ...}
    {"do": "drop", "name": NAME}

With the one argument ``first`` and a file it measures a first call instead and ends.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

began = time.perf_counter()

import jax  # noqa: E402 (after the clock)

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402 (after x64)
import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402

imported = time.perf_counter()

NEAR = 1e-4
LONG_ENOUGH = 0.3
"""Seconds that a run repeats its workload for; its answer is the median of one."""


def _of_either(*names: str):
    """Return the first of these that this version has: a public name may differ between trees."""
    return next(getattr(jd, name) for name in names if hasattr(jd, name))


rigidity_from_material = _of_either("rigidity_from_material", "material")


class Load:
    """The arrays of a workload."""

    def __init__(self, file: str) -> None:
        with np.load(file) as arrays:
            self.vertices, self.faces = arrays["vertices"], arrays["faces"]
            self.handles, self.targets = arrays["handles"], arrays["targets"]
            self.start = arrays["start"]

    def precompute(self, scale: float = 1.0, dtype: type = np.float64):
        mesh = jd.Mesh(self.vertices * scale, self.faces)
        return jd.precompute(mesh, self.handles, dtype=dtype)


Job = tuple[Callable[[], object], str]
"""What to time, and a note for the report."""


def iteration(load: Load, dtype: str, steps: int) -> Job:
    kind = np.dtype(dtype).type
    problem = load.precompute(dtype=kind)
    rigidity = np.asarray(rigidity_from_material(problem, 0.2))
    solver, start = jd.Alternating(steps), load.start.astype(kind)
    return lambda: jd.deform(problem, load.targets, rigidity, solver=solver, start=start), ""


def descent(load: Load, rigidity: float) -> Job:
    """Return QuasiNewton's way to within NEAR of the minimum that it finds itself."""
    problem = load.precompute()
    exact = jd.QuasiNewton(tolerance=1e-13, max_steps=3000)
    out = jd.deform(problem, load.targets, rigidity, solver=exact, start=load.start)
    energy = np.asarray(out.energy)[: int(out.steps) + 1]
    steps = int(np.flatnonzero(energy <= energy.min() * (1 + NEAR))[0])
    # An older version has no such search, and no name for it.
    to_the_end: dict[str, Any] = (
        {"leave_saddles": False} if hasattr(jd.QuasiNewton, "leave_saddles") else {}
    )
    solver = jd.QuasiNewton(max_steps=steps, tolerance=0.0, **to_the_end)
    note = f"{steps} steps, minimum {energy.min():.6g}"
    return lambda: jd.deform(problem, load.targets, rigidity, solver=solver, start=load.start), note


def batch(load: Load, size: int) -> Job:
    problem, rigidities = load.precompute(), jnp.asarray(np.geomspace(0.05, 50.0, size))
    many = jax.jit(jax.vmap(lambda r: jd.deform(problem, load.targets, r).vertices))
    return lambda: many(rigidities), ""


def gradient(load: Load) -> Job:
    """Return value and gradient to one unknown, implicit."""
    problem = load.precompute()
    base = rigidity_from_material(problem, 0.2)

    def loss(s):
        out = jd.deform(problem, load.targets, s * base, start=load.start)
        return jnp.sum((out.vertices - load.vertices) ** 2)

    run, one = jax.jit(jax.value_and_grad(loss)), jnp.asarray(1.0)
    return lambda: run(one), f"value {float(run(one)[0]):.6g}"


def precompute(load: Load, steps: int) -> Job:
    """Return precomputation with that many steps after it, of another mesh in every run.

    A version may keep factors by the content of the matrix, or make them at the first use. So the
    mesh is scaled a little further each time, and with steps the factor is used.
    """
    runs, solver = iter(range(1, 1 << 30)), jd.Alternating(max(1, steps))

    def run():
        problem = load.precompute(scale=1.0 + 1e-9 * next(runs))
        if not steps:
            return problem
        return jd.deform(problem, load.targets, 1.0, solver=solver, start=load.start)

    return run, ""


KINDS: dict[str, Callable[..., Job]] = {
    f.__name__: f for f in (iteration, descent, batch, gradient, precompute)
}


def seconds_of_one(run: Callable[[], object]) -> float:
    times: list[float] = []
    while sum(times) < LONG_ENOUGH:
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def first_call(file: str) -> dict[str, float]:
    """Return the seconds of import, of precomputation and of the first deformation."""
    load = Load(file)
    start = time.perf_counter()
    problem = load.precompute()
    ready = time.perf_counter()
    jax.block_until_ready(jd.deform(problem, load.targets, 1.0))
    done = time.perf_counter()
    return {"import": imported - began, "precompute": ready - start, "deform": done - ready}


def serve() -> None:
    jobs: dict[str, Job] = {}
    for line in sys.stdin:
        command = json.loads(line)
        do, name = command.pop("do"), command.pop("name")
        answer = {}
        if do == "prepare":
            kind, load = command.pop("kind"), Load(command.pop("file"))
            jobs[name] = KINDS[kind](load, **command)
            jax.block_until_ready(jobs[name][0]())
        elif do == "run":
            answer = {"seconds": seconds_of_one(jobs[name][0]), "note": jobs[name][1]}
        else:
            del jobs[name]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    print(json.dumps({"tree": str(Path(str(jd.__file__)).parents[1])}), flush=True)
    if sys.argv[1:2] == ["first"]:
        print(json.dumps(first_call(sys.argv[2])), flush=True)
    else:
        serve()
