"""The solvers of the local step on one set of cells: time, and how far apart they end."""

import jax
import jax.numpy as jnp

import jaxdeform as jd
from benchmarks import internals, workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Findings, Metric


def run(quick: bool) -> Findings:
    load = workloads.bar() if quick else workloads.cylinder()
    problem = jd.precompute(load.mesh, load.handles)
    rigidity = workloads.material(problem)
    c, moments = internals.local_step_inputs(problem, load.start)
    minimize = jax.jit(
        lambda c, b, rigidity, local: local.minimize(c, b, rigidity), static_argnames=("local",)
    )
    solvers = [jd.Newton(), jd.LBFGS(), jd.GradientDescent(), jd.RotationFit(), jd.AffineFit()]
    runs = {
        type(local).__name__: lambda local=local: minimize(c, moments, rigidity, local)
        for local in solvers
    }
    seconds = interleaved(runs, 3 if quick else 7)
    out = [Metric(f"local step, {k}", load.name, 1e3 * v, "ms") for k, v in seconds.items()]
    ratio = seconds["Newton"] / seconds["LBFGS"]
    out.append(Metric("local step, Newton / LBFGS", load.name, ratio, "1"))
    far = float(jnp.abs(runs["Newton"]() - runs["LBFGS"]()).max())
    out.append(Metric("largest difference in T, Newton and LBFGS", load.name, far, "", 1e-6))
    return Findings(out)
