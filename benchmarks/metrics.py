"""What a benchmark finds: metrics, their report, and the gate against a baseline."""

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version

Curve = tuple[list[float], list[float]]
"""The x and the y values of one line of a picture."""


@dataclass(frozen=True)
class Metric:
    """One figure of one benchmark on one workload."""

    name: str
    workload: str
    value: float
    unit: str
    """'1' for a ratio to a peer timed in the same run. The gate compares these alone."""
    target: float | None = None
    """Reached when the value is at most this (at least this, where more is better)."""
    more_is_better: bool = False
    tolerance: float = 0.25
    """Fraction by which the value may be worse than the baseline before the gate fails."""
    note: str = ""

    @property
    def reached(self) -> bool | None:
        if self.target is None:
            return None
        return self.value >= self.target if self.more_is_better else self.value <= self.target


@dataclass(frozen=True)
class Findings:
    """What a suite returns."""

    metrics: list[Metric]
    curves: dict[str, dict[str, Curve]] = field(default_factory=dict)
    """For each picture, by title: its lines, by label."""


def machine() -> dict[str, str]:
    """Return what the figures depend on: the processor, the system and the versions."""
    names = ("jax", "jaxlib", "numpy", "scipy", "libigl", "cholespy", "open3d")
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    processor = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as lines:
            processor = next(x.split(":")[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "processor": f"{processor}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "system": platform.system(),
        **found,
    }


def as_json(metrics: Sequence[Metric]) -> str:
    return json.dumps({"machine": machine(), "metrics": [asdict(m) for m in metrics]}, indent=1)


def as_markdown(metrics: Sequence[Metric]) -> str:
    """Return the metrics as a table."""
    lines = [
        "Measured on: " + ", ".join(f"{k} {v}" for k, v in machine().items()) + ".",
        "",
        "| metric | workload | value | target | reached |",
        "|---|---|---:|---:|---|",
    ]
    for m in metrics:
        unit = "" if m.unit == "1" else f" {m.unit}"
        sign = "≥" if m.more_is_better else "≤"
        target = "" if m.target is None else f"{sign} {m.target:g}{unit}"
        reached = {None: "", True: "yes", False: "**no**"}[m.reached]
        note = f" ({m.note})" if m.note else ""
        lines.append(
            f"| {m.name} | {m.workload}{note} | {m.value:.3g}{unit} | {target} | {reached} |"
        )
    return "\n".join(lines) + "\n"


def gate(metrics: Sequence[Metric], baseline: str) -> list[str]:
    """Return a sentence for each ratio that is worse than the baseline by more than its tolerance.

    Absolute times differ from machine to machine and are not compared.
    """
    before = {
        (m["name"], m["workload"]): m["value"]
        for m in json.loads(baseline)["metrics"]
        if m["unit"] == "1"
    }
    worse = []
    for m in metrics:
        old = before.get((m.name, m.workload))
        if old is None or m.unit != "1":
            continue
        limit = old * (1 - m.tolerance) if m.more_is_better else old * (1 + m.tolerance)
        if (m.value < limit) if m.more_is_better else (m.value > limit):
            worse.append(f"{m.name}, {m.workload}: {m.value:.3g}, was {old:.3g}")
    return worse
