"""Value and gradient against one deformation, for one unknown and for one a vertex."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric

CASES = {
    "unrolled": (jd.Alternating(100), jd.Unrolled(), 4.0),
    "implicit": (jd.QuasiNewton(), jd.Implicit(), 2.5),
}
"""Solver, adjoint, and the most that value and gradient may cost, in deformations."""


def run(quick: bool) -> Findings:
    load = workloads.bar() if quick else workloads.cylinder()
    problem = jd.precompute(load.mesh, load.handles)
    base = workloads.material(problem)
    observed = jd.deform(problem, load.targets, 2.0 * base, start=load.start).vertices
    out = []
    for kind, (solver, adjoint, target) in CASES.items():

        def loss(rigidity, solver=solver, adjoint=adjoint):
            solution = jd.deform(
                problem, load.targets, rigidity, solver=solver, adjoint=adjoint, start=load.start
            )
            return jnp.sum((solution.vertices - observed) ** 2)

        seconds = interleaved(_runs(loss, base, with_field=not quick), 3 if quick else 5)
        value = seconds.pop("value")
        for unknowns, spent in seconds.items():
            name = f"value and gradient / one deformation, {kind}, {unknowns}"
            out.append(Metric(name, load.name, spent / value, "1", target))
    return Findings(out)


def _runs(loss, base, with_field: bool) -> dict[str, Callable[[], object]]:
    plain, field = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
    scalar, one = jax.jit(jax.value_and_grad(lambda s: loss(s * base))), jnp.asarray(1.0)
    runs: dict[str, Callable[[], object]] = {
        "value": lambda: plain(base),
        "1 unknown": lambda: scalar(one),
    }
    if with_field:
        runs["n unknowns"] = lambda: field(base)
    return runs
