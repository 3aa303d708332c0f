"""64 rigidities of the bar under vmap, per deformation, against one alone."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric


def run(quick: bool) -> Findings:
    load = workloads.bar()
    problem = jd.precompute(load.mesh, load.handles)
    rigidities = jnp.asarray(np.geomspace(0.05, 50.0, 64))
    out = []
    for solver in (jd.QuasiNewton(),) if quick else (jd.Alternating(100), jd.QuasiNewton()):
        one = jax.jit(
            lambda r, solver=solver: jd.deform(problem, load.targets, r, solver=solver).vertices
        )
        many = jax.jit(jax.vmap(one))
        seconds = interleaved(
            {
                "many": lambda many=many: many(rigidities),
                # Rigidities need different numbers of steps, so 'one' is the mean of eight.
                "one": lambda one=one: [jax.block_until_ready(one(r)) for r in rigidities[::8]],
            },
            3 if quick else 15,
        )
        kind = f"batch of 64, {type(solver).__name__}"
        ratio = (seconds["many"] / 64) / (seconds["one"] / 8)
        out.append(Metric(f"{kind}, time per member / single", load.name, ratio, "1", 0.7))
        label, rate = f"deformations a second, {kind}", 64 / seconds["many"]
        out.append(Metric(label, load.name, rate, "/s", more_is_better=True))
    return Findings(out)
