"""Interleaved timing, child processes, and the registry of suites."""

import importlib
import json
import sys
import time
from pathlib import Path

import pytest

from benchmarks import harness
from benchmarks.suites import SUITES, iteration

FOLDER = Path(harness.__file__).parent


def test_runs_take_turns_after_one_untimed_run_each():
    order = []
    runs = {name: lambda name=name: order.append(name) for name in "abc"}
    harness.interleaved(runs, 2)
    assert "".join(order) == "abc" + "abc" * 2


def test_seconds_are_the_median_of_the_timed_runs(monkeypatch):
    # The clock moves in the runs alone: the first, untimed, by 1000 seconds, then by 3, 1 and 2.
    now, steps = [0.0], iter([1000.0, 3.0, 1.0, 2.0])
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def run():
        now[0] += next(steps)

    assert harness.interleaved({"run": run}, 3) == {"run": 2.0}


def test_a_failing_child_says_which_and_why():
    with pytest.raises(RuntimeError, match=r"(?s)no_such_child failed.*No module named"):
        harness.run_child("no_such_child")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_peak_memory_is_that_of_this_process():
    assert 0.01 < harness.peak_gib() < 1000


def test_every_suite_and_no_other_is_registered():
    files = {path.stem for path in (FOLDER / "suites").glob("*.py")} - {"__init__"}
    assert set(SUITES) == files
    assert all(run.__module__ == f"benchmarks.suites.{name}" for name, run in SUITES.items())


def test_children_can_be_imported_without_running():
    for path in (FOLDER / "children").glob("*.py"):
        importlib.import_module(f"benchmarks.children.{path.stem}".removesuffix(".__init__"))


def test_names_and_workloads_are_those_of_the_baseline(monkeypatch):
    """They are the keys of the baseline: the gate would pass over a new one unseen."""
    kept = json.loads((FOLDER / "baseline.json").read_text())["metrics"]
    known = {(m["name"], m["workload"], m["unit"]) for m in kept}
    monkeypatch.setattr(iteration, "interleaved", lambda runs, repeats: dict.fromkeys(runs, 1.0))
    found = iteration.run(True).metrics
    assert {(m.name, m.workload, m.unit) for m in found} <= known
    assert any(m.unit == "1" for m in found)
