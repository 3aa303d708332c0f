"""What every benchmark needs: interleaved timing, child processes, metrics, a gate."""

import gc
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any


@dataclass(frozen=True)
class Metric:
    """One figure of one benchmark on one workload."""

    name: str
    workload: str
    value: float
    unit: str
    """A ratio to a peer in the same run has the unit '1'; it is what the gate looks at."""
    target: float | None = None
    """Reached when the value is at most this (at least, where more is better)."""
    more_is_better: bool = False
    tolerance: float = 0.25
    """Part by which the value may get worse than the baseline before the gate closes."""
    note: str = ""

    @property
    def reached(self) -> bool | None:
        if self.target is None:
            return None
        return self.value >= self.target if self.more_is_better else self.value <= self.target


def interleaved(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median seconds of each run; they take turns, so that drift hits all alike."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    gc.collect()
    gc.disable()
    try:
        for _ in range(repeats):
            for name, run in runs.items():
                began = time.perf_counter()
                run()
                times[name].append(time.perf_counter() - began)
    finally:
        gc.enable()
    return {name: statistics.median(values) for name, values in times.items()}


def child(code: str, *, environment: dict[str, str] | None = None) -> Any:
    """Run Python code in a process of its own; return the JSON that it prints last."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **(environment or {})},
    )
    if done.returncode:
        raise RuntimeError(f"the child process failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


PEAK = """
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
peak_gib = int(status["VmHWM"].split()[0]) / 2**20
"""
"""Code for a child: its peak resident memory (of Linux, in KiB there).

Not getrusage's: that starts from what the parent had when it made the child."""


def machine() -> dict[str, str]:
    """Return what the figures depend on."""
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


# ---------------------------------------------------------------- reports and the gate


def as_json(metrics: Sequence[Metric]) -> str:
    return json.dumps({"machine": machine(), "metrics": [asdict(m) for m in metrics]}, indent=1)


def as_markdown(metrics: Sequence[Metric]) -> str:
    """Return the results as a table."""
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
    """Return a sentence for each ratio that got worse than the baseline by over its tolerance.

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
