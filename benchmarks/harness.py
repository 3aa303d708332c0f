"""How benchmarks are run: in turns within one process, or each in a process of its own."""

import gc
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

ROOT = Path(__file__).parents[1]
PROGRAM = Path(sys.executable).parent / "jaxdeform"
"""The command line, as it was installed beside this Python."""


def interleaved(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median seconds of each run.

    Each runs once before the clock starts. Then they take turns, so that a machine that changes
    its pace changes it for all of them. A run ends when the arrays that it returns are computed.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        jax.block_until_ready(run())
    gc.collect()
    gc.disable()
    try:
        for _ in range(repeats):
            for name, run in runs.items():
                began = time.perf_counter()
                jax.block_until_ready(run())
                times[name].append(time.perf_counter() - began)
    finally:
        gc.enable()
    return {name: statistics.median(values) for name, values in times.items()}


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Yield a list to which the name of each function that XLA compiles meanwhile is added."""
    compiled: list[str] = []

    def listen(event: str, duration_secs: float, **rest: Any) -> None:
        del duration_secs
        if event.endswith("backend_compile_duration"):
            compiled.append(rest["fun_name"].removeprefix("jit(").removesuffix(")"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def run_child(name: str, *arguments: object, environment: Mapping[str, str] | None = None) -> Any:
    """Run ``benchmarks/children/NAME.py`` in a new process and return the JSON it prints last.

    Raises RuntimeError with the end of its error output where it fails.
    """
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.children.{name}", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **(environment or {})},
    )
    if done.returncode:
        raise RuntimeError(f"the child process {name} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def peak_gib() -> float:
    """Return the peak resident memory of this process in GiB (Linux only).

    getrusage would not do: its figure starts from what the parent had when it made the child.
    """
    with open("/proc/self/status") as lines:
        status = dict(line.split(":", 1) for line in lines)
    return int(status["VmHWM"].split()[0]) / 2**20
