"""Time what JAX's default device does with one workload in one precision; print seconds by name.

``python -m benchmarks.children.one_device WORKLOAD PRECISION BATCH REPEATS FILE``. The file gets
vertices and energy of a deformation to a tight tolerance. With a batch, that many deformations run
together, each with its own rigidity and targets. Set JAX_PLATFORMS=cpu to time the host.
"""

import json
import sys
import time
from collections.abc import Callable

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402 (after x64)
import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402
from benchmarks import workloads  # noqa: E402
from benchmarks.harness import interleaved  # noqa: E402
from benchmarks.workloads import Workload  # noqa: E402

LOADS: dict[str, Callable[[], Workload]] = {
    "bar": workloads.bar,
    "cylinder": workloads.cylinder,
    "cactus": workloads.cactus,
    "octopus": lambda: workloads.octopus(50_000),
}
STEPS = 20
TIGHT = jd.QuasiNewton(tolerance=1e-16, max_steps=3000)
ALONE = 16
"""So many members of a batch are also deformed one by one."""


def main(name: str, precision: str, batch: int, repeats: int, file: str) -> dict[str, float]:
    load, kind = LOADS[name](), np.dtype(precision).type
    began = time.perf_counter()
    problem = jax.block_until_ready(jd.precompute(load.mesh, load.handles, dtype=kind))
    found = {"precomputation": time.perf_counter() - began}
    rigidity = np.asarray(workloads.material(problem))
    start = load.start.astype(kind)

    def deformed(solver: jd.Solver) -> jd.Solution:
        return jd.deform(problem, load.targets, rigidity, solver=solver, start=start)

    began = time.perf_counter()
    out = jax.block_until_ready(deformed(jd.QuasiNewton()))
    found |= {"first call": time.perf_counter() - began, "steps": int(out.steps)}
    slope = _slope(problem, load, rigidity, start)
    seconds = interleaved(
        {
            "one deformation": lambda: deformed(jd.QuasiNewton()),
            "alternating": lambda: deformed(jd.Alternating(STEPS)),
            "value and gradient": lambda: slope(problem, kind(1.0)),
        },
        repeats,
    )
    seconds["one alternating iteration"] = seconds.pop("alternating") / STEPS
    # In float32 the default tolerance is where rounding ends the descent.
    tight = deformed(TIGHT) if kind is np.float64 else out
    last = float(tight.energy[-1])
    np.savez(file, vertices=np.asarray(tight.vertices), energy=last)
    found |= {"not ok": float(not (out.ok & tight.ok)), "tight steps": int(tight.steps)}
    return found | seconds | (_together(problem, load, batch, repeats) if batch else {})


def _slope(problem: jd.Problem, load: Workload, rigidity, start):
    def loss(problem, scale):
        out = jd.deform(problem, load.targets, scale * rigidity, start=start)
        return jnp.sum((out.vertices - load.mesh.vertices.astype(start.dtype)) ** 2)

    return jax.jit(jax.value_and_grad(loss, argnums=1))


def _together(problem: jd.Problem, load: Workload, batch: int, repeats: int) -> dict[str, float]:
    ends = load.mesh.vertices[load.handles]
    angles, kind = np.linspace(30.0, 90.0, batch), problem.dtype
    targets = jnp.asarray(np.stack([jd.bend(ends, angle) for angle in angles]), kind)
    rigidities = jnp.asarray(np.geomspace(0.05, 50.0, batch), kind)
    one = jax.jit(lambda problem, targets, rigidity: jd.deform(problem, targets, rigidity))
    many = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))
    few = [(targets[k], rigidities[k]) for k in range(0, batch, max(1, batch // ALONE))]
    out, alone = many(problem, targets, rigidities), [one(problem, *x) for x in few]
    apart = np.abs(out.vertices[:: max(1, batch // ALONE)] - np.stack([x.vertices for x in alone]))
    seconds = interleaved(
        {
            "together": lambda: many(problem, targets, rigidities),
            "alone": lambda: [jax.block_until_ready(one(problem, *x)) for x in few],
        },
        repeats,
    )
    return {
        "one of a batch": seconds["together"] / batch,
        "one of a batch, one by one": seconds["alone"] / len(few),
        "batch apart": float(apart.max()) / load.mesh.diagonal,
        "batch not ok": float(np.sum(~np.asarray(out.ok))),
    }


if __name__ == "__main__":
    load, precision, batch, repeats, file = sys.argv[1:]
    print(json.dumps(main(load, precision, int(batch), int(repeats), file)))
