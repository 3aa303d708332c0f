"""Time to come within 1e-4 of the minimum, the same functional evaluated for all."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import jaxdeform as jd
from benchmarks import workloads
from benchmarks.harness import interleaved
from benchmarks.metrics import Curve, Findings, Metric
from benchmarks.workloads import Workload
from jaxdeform._errors import ArrayLike

NEAR = 1e-4
MOST = 3000
"""Iterations of a peer at most."""


class Case(NamedTuple):
    """What is minimised, and the most time it may take, as a fraction of libigl's."""

    name: str
    problem: jd.Problem
    rigidity: ArrayLike
    local: jd.LocalStep
    target: float


class Ours(NamedTuple):
    """How QuasiNewton gets near the minimum."""

    of: Callable[[jd.Problem], object]
    """Runs it on a problem like that of the case."""
    run: Callable[[], object]
    """Runs it on that of the case."""
    energies: list[float]
    """After each iteration, relative to the minimum, less 1."""


def run(quick: bool) -> Findings:
    loads = [workloads.bar()]
    if not quick:
        loads += [workloads.cylinder(), workloads.cactus()]
    metrics, curves = [], {}
    for load in loads:
        metrics_of, curves[load.name] = _convergence(load, repeats=3 if quick else 7)
        metrics += metrics_of
    return Findings(metrics, curves)


def _convergence(load: Workload, repeats: int) -> tuple[list[Metric], dict[str, Curve]]:
    rigid = jd.precompute(load.mesh, load.handles, cells=jd.spokes(load.mesh))
    problem = jd.precompute(load.mesh, load.handles)
    cases = [Case("rigid limit", rigid, 0.0, jd.RotationFit(), 0.4)]
    cases += [Case(f"rigidity {x:g}", problem, x, jd.Newton(), 0.8) for x in (1.0, 0.05)]
    peer = peer_descent(load, rigid, libigl_by_tens(load))
    data = load.libigl(peer.steps)
    ours = {case.name: our_descent(load, case) for case in cases}
    runs: dict[str, Callable[[], object]] = {"libigl": lambda: load.run_libigl(data, peer.steps)}
    seconds = interleaved(runs | {name: x.run for name, x in ours.items()}, repeats)
    per = seconds["libigl"] / len(peer.energies)
    after = [k * per for k in range(1, len(peer.energies) + 1)]
    curves: dict[str, Curve] = {"libigl ARAP, rigid": (after, peer.energies)}
    for name, (*_, energies) in ours.items():
        per = seconds[name] / max(1, len(energies) - 1)
        curves[f"jaxdeform, {name}"] = ([k * per for k in range(len(energies))], energies)
    return _metrics(load, cases, seconds, peer.note), curves


def _metrics(load: Workload, cases: list[Case], seconds, note: str) -> list[Metric]:
    out = []
    for case in cases:
        label = f"time to within 1e-4 of the minimum, {case.name} / libigl's rigid ARAP"
        spent = seconds[case.name]
        out.append(Metric(label, load.name, spent / seconds["libigl"], "1", case.target))
        out.append(Metric(f"time to within 1e-4, {case.name}", load.name, 1e3 * spent, "ms"))
    spent = 1e3 * seconds["libigl"]
    out.append(Metric("time to within 1e-4, libigl", load.name, spent, "ms", note=note))
    return out


def libigl_by_tens(load: Workload) -> Callable[[], np.ndarray]:
    """Return what runs ten more iterations of libigl each time."""
    data, p = load.libigl(10), load.start

    def go_on() -> np.ndarray:
        nonlocal p
        p = load.run_libigl(data, 10, start=p)
        return p

    return go_on


def our_descent(load: Workload, case: Case) -> Ours:
    """Return QuasiNewton's run to within NEAR of its own minimum."""
    energy = energies_of(load, case.problem, case.rigidity, case.local)
    least = energy.min()
    steps = int(np.flatnonzero(energy <= least * (1 + NEAR))[0])
    solver = jd.QuasiNewton(max_steps=steps, tolerance=0.0, leave_saddles=False)

    def of(problem):
        return jd.deform(
            problem,
            load.targets,
            case.rigidity,
            local=case.local,
            solver=solver,
            start=load.start,
        )

    return Ours(of, lambda: of(case.problem), (energy[: steps + 1] / least - 1).tolist())


class PeerDescent(NamedTuple):
    """How a rigid method of others gets near its end."""

    energies: list[float]
    """After each ten of its iterations, relative to our minimum, less 1: ours to judge."""

    @property
    def steps(self) -> int:
        """The iterations until it is near."""
        return 10 * len(self.energies)

    @property
    def note(self) -> str:
        """What the table says of it."""
        above = 100 * self.energies[-1]
        where = "" if above <= 100 * NEAR else f", {above:.2g} % above our rigid minimum"
        return f"{self.steps} iterations{where}"


def peer_descent(
    load: Workload, problem: jd.Problem, go_on: Callable[[], np.ndarray]
) -> PeerDescent:
    """Let ``go_on`` do ten iterations at a time until they end near our rigid minimum.

    Where none does in ``MOST`` iterations, near the lowest that they reach: on the cactus we leave
    out weights that leave the energy without a bound, so others minimise another functional.
    """
    local = jd.RotationFit()
    least = float(energies_of(load, problem, 0.0, local)[-1])
    energies: list[float] = []
    while len(energies) < MOST // 10 and not (energies and energies[-1] <= NEAR):
        energies.append(load.reduced_energy(problem, go_on(), 0.0, local) / least - 1.0)
    near = NEAR if min(energies) <= NEAR else min(energies) + NEAR
    first = next(k for k, energy in enumerate(energies) if energy <= near)
    return PeerDescent(energies[: first + 1])


def energies_of(load: Workload, problem: jd.Problem, rigidity: ArrayLike, local: jd.LocalStep):
    """Return the energy at the start and after each iteration, down to where a descent ends.

    That may be a saddle, as it is for the peers, which do not leave it either.
    """
    solver = jd.QuasiNewton(tolerance=1e-13, max_steps=3000, leave_saddles=False)
    out = jd.deform(problem, load.targets, rigidity, local=local, solver=solver, start=load.start)
    return np.asarray(out.energy)[: int(out.steps) + 1]
