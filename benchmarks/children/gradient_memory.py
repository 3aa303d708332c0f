"""Take a value and a gradient through alternating steps; print the peak memory in GiB.

``python -m benchmarks.children.gradient_memory ADJOINT STEPS``
"""

import json
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402 (after x64)

import jaxdeform as jd  # noqa: E402
from benchmarks import harness, workloads  # noqa: E402


def main(adjoint: str, steps: int) -> float:
    load = workloads.tube(20_000)
    problem = jd.precompute(load.mesh, load.handles)
    base = workloads.material(problem)
    solver, rule = jd.Alternating(steps), getattr(jd, adjoint)()
    # From the minimum: far from it the derivative of Implicit would be NaN after 50 steps.
    start = jd.deform(problem, load.targets, base).vertices

    def loss(s):
        out = jd.deform(problem, load.targets, s * base, solver=solver, adjoint=rule, start=start)
        return jnp.sum(out.vertices**2)

    _, slope = jax.jit(jax.value_and_grad(loss))(1.0)
    if not bool(jnp.isfinite(slope)):
        raise RuntimeError(f"the gradient is {slope}")
    return harness.peak_gib()


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]))))
