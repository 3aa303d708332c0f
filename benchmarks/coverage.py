"""Do 95 % intervals cover the truth in 95 of 100 cases? ``python -m benchmarks.coverage``.

Simulation-based calibration (Talts et al. 2018): each seed draws a truth and the noise, a pose is
made of them, and the whole nonlinear estimate runs on it. Poses are solved to a tolerance of 1e-12.
Fits are at their default, whose own error the intervals include; ``--tight`` fits to 1e-11.

``--fields wave halves prior`` does the same for fields: in which share of all vertices does the
interval hold?
"""

import argparse
from collections.abc import Iterable
from functools import cached_property
from itertools import product
from typing import NamedTuple

import jax
import numpy as np

import jaxdeform as jd
from benchmarks.workloads import small_bar
from jaxdeform._mesh.laplacian import cotangent_weights, graph_laplacian, lifted_weights

EXACT = jd.QuasiNewton(tolerance=1e-12, leave_saddles=False)
TIGHT = jd.QuasiNewton(tolerance=1e-11, leave_saddles=False)
DEFAULT = jd.QuasiNewton(leave_saddles=False)
NOISES = 1e-5, 1e-4, 1e-3
"""Standard deviations of a coordinate, as fractions of the diagonal."""
SOFTEST, STIFFEST = 1.0, 100.0
"""Truths are drawn between these, uniformly in their logarithm."""


class Case(NamedTuple):
    """What is estimated from what."""

    parts: int
    """1, or the two halves of the bar."""
    known: bool
    """Whether the targets are given; else they are the noisy positions of the handles."""
    noise: float
    solver: jd.QuasiNewton = DEFAULT
    """Of the fit."""


class Draw(NamedTuple):
    """One estimate beside the truth."""

    truth: np.ndarray
    fit: jd.Estimate

    @property
    def covered(self) -> np.ndarray:
        """Whether the interval of each part holds the truth."""
        low, high = self.fit.interval.T
        return (low <= self.truth) & (self.truth <= high)

    @property
    def central(self) -> np.ndarray:
        """Whether the middle half of the interval does, in log rigidity."""
        ends = np.log(self.fit.interval)
        middle = np.abs(np.log(self.truth) - ends.mean(axis=1))
        return middle <= 0.25 * np.ptp(ends, axis=1)


class Bar:
    """The bar, decimated to 262 vertices, bent by 90 degrees and held at both ends."""

    @cached_property
    def problem(self) -> jd.Problem:
        # An estimate takes 0.3 to 0.9 s there, and 0.4 to 3 s on the whole bar.
        mesh = small_bar()
        return jd.precompute(mesh, jd.select.where(mesh, "v < 0.06 or v > 0.94"))

    @cached_property
    def targets(self) -> np.ndarray:
        return np.asarray(jd.bend(self.problem.mesh.vertices[self.problem.handles], 90.0))

    def draw(self, case: Case, seed: int) -> Draw:
        """Draw a truth and a noisy pose of it, and estimate."""
        mesh, random = self.problem.mesh, np.random.default_rng(seed)
        label = (mesh.vertices[:, 1] > 75.5).astype(int) * (case.parts - 1)
        truth = SOFTEST * (STIFFEST / SOFTEST) ** random.uniform(size=case.parts)
        out = jd.deform(self.problem, self.targets, truth[label], solver=EXACT)
        noise = case.noise * mesh.diagonal * random.standard_normal(mesh.vertices.shape)
        fit = jd.estimate_rigidity(
            self.problem,
            np.asarray(out.vertices) + noise,
            parts=label,
            targets=self.targets if case.known else None,
            solver=case.solver,
        )
        return Draw(truth, fit)


FIELDS = "wave", "halves", "prior"
"""Rigidity along the bar: a wave of random phase, half as long again as it, or two halves; or what
the smooth prior takes for likely, everywhere."""


def draw_truth(kind: str, mesh: jd.Mesh, random: np.random.Generator) -> np.ndarray:
    """Draw a field of rigidity."""
    along = mesh.vertices[:, 1] / np.ptp(mesh.vertices[:, 1])
    if kind == "wave":
        wave = np.sin(2 * np.pi * (along / 1.5 + random.uniform()))
        return 10.0 ** (random.uniform(0.0, 1.0) + 0.5 * wave)
    if kind == "halves":
        return 100.0 ** random.uniform(size=2)[(along > 0.5).astype(int)]
    weights = lifted_weights(cotangent_weights(mesh))
    laplacian = graph_laplacian(mesh.edges, weights, mesh.n_vertices).toarray()
    stiffness, modes = np.linalg.eigh(laplacian)
    field = modes[:, 1:] @ (random.standard_normal(len(modes) - 1) / np.sqrt(stiffness[1:]))
    return 10.0 ** (random.uniform(0.0, 1.0) + 0.5 * field)


class FieldDraw(NamedTuple):
    """One estimated field beside the truth, at the vertices that are free."""

    truth: np.ndarray
    rigidity: np.ndarray
    interval: np.ndarray
    determined: np.ndarray
    smoothness: float
    ok: bool

    @property
    def covered(self) -> float:
        """The share of vertices whose interval holds the truth."""
        low, high = self.interval.T
        return float(np.mean((low <= self.truth) & (self.truth <= high)))

    @property
    def error(self) -> float:
        """The median error of log rigidity."""
        return float(np.median(np.abs(np.log(self.rigidity / self.truth))))


def draw_field(bar: Bar, kind: str, poses: int, noise: float, seed: int) -> FieldDraw:
    """Draw a field and noisy poses of it, bent by up to 90 degrees, and estimate it."""
    problem, random = bar.problem, np.random.default_rng(seed)
    mesh, handles = problem.mesh, problem.handles
    truth = draw_truth(kind, mesh, random)
    rest = mesh.vertices[handles]
    angles = 90.0 * np.arange(1, poses + 1) / poses
    targets = np.stack([np.asarray(jd.bend(rest, angle)) for angle in angles])
    made = [jd.deform(problem, each, truth, solver=EXACT).vertices for each in targets]
    seen = np.stack(made) + noise * mesh.diagonal * random.standard_normal(
        (poses, mesh.n_vertices, 3)
    )
    fit = jd.estimate_rigidity_field(problem, seen, targets=targets)
    free = np.setdiff1d(np.arange(mesh.n_vertices), handles)
    return FieldDraw(
        truth[free],
        fit.field[free],
        fit.interval[free],
        fit.determined[free],
        fit.smoothness,
        fit.ok,
    )


def field_row(kind: str, poses: int, noise: float, draws: list[FieldDraw]) -> str:
    """Return a row of the table of fields."""
    covered = 100 * np.array([draw.covered for draw in draws])
    determined = 100 * np.mean([draw.determined.mean() for draw in draws])
    return (
        f"| {kind} | {poses} | {noise:g} | {covered.mean():.1f} ± "
        f"{covered.std() / np.sqrt(len(draws)):.1f} | {covered.min():.0f} | {determined:.0f} | "
        f"{np.median([draw.error for draw in draws]):.3f} | "
        f"{np.median([draw.smoothness for draw in draws]):.1g} | "
        f"{sum(not draw.ok for draw in draws)} |"
    )


def share(hits: Iterable[bool]) -> str:
    """Return the share of hits in per cent, with its binomial standard error."""
    values = np.array(list(hits), float)
    p = values.mean()
    return f"{100 * p:.1f} ± {100 * np.sqrt(p * (1 - p) / len(values)):.1f}"


def as_row(case: Case, draws: list[Draw]) -> str:
    """Return a row of the table: shares in per cent, the half-width as a factor."""
    parts = ", ".join(share(draw.covered[part] for draw in draws) for part in range(case.parts))
    central = share(hit for draw in draws for hit in draw.central)
    wide = np.concatenate([np.log(draw.fit.interval) @ [-0.5, 0.5] for draw in draws])
    alarms = sum(draw.fit.result == jd.Result.unexplained for draw in draws)
    none = sum(not draw.fit.ok for draw in draws) - alarms
    return (
        f"| {case.parts} | {'known' if case.known else 'observed'} | {case.noise:g} | {parts} | "
        f"{central} | {np.exp(np.median(wide)):.4g} | {alarms} | {none} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("--seeds", type=int, default=400)
    parser.add_argument("--tight", action="store_true", help="fit to a tolerance of 1e-11")
    parser.add_argument("--fields", nargs="+", choices=FIELDS, help="fields instead of parts")
    options = parser.parse_args()
    bar = Bar()
    if options.fields:
        print(
            "| field | poses | noise | covered | least | determined | error | smoothness | none |"
        )
        print("|---|---|---|---|---|---|---|---|---|")
        for kind, poses, noise in product(options.fields, (1, 3), (1e-4, 1e-3)):
            draws = [draw_field(bar, kind, poses, noise, seed) for seed in range(options.seeds)]
            print(field_row(kind, poses, noise, draws), flush=True)
        return
    print(
        f"{bar.problem.mesh.n_vertices} vertices, {options.seeds} seeds a row, shares in per cent"
    )
    print("| parts | targets | noise | covered | by the middle half | factor | alarms | none |")
    print("|---|---|---|---|---|---|---|---|")
    for parts, known, noise in product((1, 2), (True, False), NOISES):
        case = Case(parts, known, noise, TIGHT if options.tight else DEFAULT)
        print(as_row(case, [bar.draw(case, seed) for seed in range(options.seeds)]), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
