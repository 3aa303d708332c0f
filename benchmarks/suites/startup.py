"""Import and first deformation in a new process, with and without JAX's compilation cache."""

import statistics
import tempfile

from benchmarks.harness import run_child
from benchmarks.metrics import Findings, Metric


def run(quick: bool) -> Findings:
    repeats = 1 if quick else 5
    with tempfile.TemporaryDirectory() as folder:
        off = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
        on = {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }
        first = statistics.median(_first(off) for _ in range(repeats))
        _first(on)  # fills the cache
        later = statistics.median(_first(on) for _ in range(repeats))
    name = "import and first deformation, new process"
    return Findings(
        [
            Metric(name, "bar", first, "s", 6.0),
            Metric(name + ", compilation cache on", "bar", later, "s", 3.0),
        ]
    )


def _first(environment: dict[str, str]) -> float:
    return run_child("first_deformation", environment=environment)
