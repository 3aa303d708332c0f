"""Metrics, their table, and the gate that compares them with a baseline."""

import json
from pathlib import Path

import pytest

from benchmarks.metrics import Metric, as_json, as_markdown, gate

BASELINE = Path(__file__).parents[2] / "benchmarks" / "baseline.json"


def test_target_direction():
    assert Metric("time", "bar", 1.0, "1", target=1.0).reached
    assert not Metric("time", "bar", 1.1, "1", target=1.0).reached
    assert Metric("rate", "bar", 20.0, "/s", target=20, more_is_better=True).reached
    assert not Metric("rate", "bar", 19.0, "/s", target=20, more_is_better=True).reached
    assert Metric("time", "bar", 1.0, "1").reached is None


@pytest.mark.parametrize(
    ("now", "more_is_better", "passes"),
    [
        (2.49, False, True),
        (2.51, False, False),
        (0.1, False, True),
        (1.51, True, True),
        (1.49, True, False),
        (100.0, True, True),
    ],
)
def test_gate_allows_the_tolerance_in_the_direction_that_is_worse(now, more_is_better, passes):
    baseline = as_json([Metric("ratio", "bar", 2.0, "1", more_is_better=more_is_better)])
    worse = gate([Metric("ratio", "bar", now, "1", more_is_better=more_is_better)], baseline)
    assert worse == ([] if passes else [f"ratio, bar: {now:.3g}, was 2"])


def test_gate_uses_the_tolerance_of_the_metric():
    baseline = as_json([Metric("ratio", "bar", 2.0, "1")])
    assert not gate([Metric("ratio", "bar", 2.9, "1", tolerance=0.5)], baseline)
    assert gate([Metric("ratio", "bar", 3.1, "1", tolerance=0.5)], baseline)


def test_gate_ignores_absolute_times_other_workloads_and_new_metrics():
    baseline = as_json([Metric("ratio", "bar", 2.0, "1"), Metric("time", "bar", 1.0, "ms")])
    now = [
        Metric("time", "bar", 100.0, "ms"),
        Metric("ratio", "cactus", 100.0, "1"),
        Metric("another", "bar", 100.0, "1"),
    ]
    assert gate(now, baseline) == []


def test_gate_passes_on_its_own_baseline_and_fails_where_all_is_worse():
    kept = json.loads(BASELINE.read_text())["metrics"]
    metrics = [Metric(**m) for m in kept]
    assert gate(metrics, BASELINE.read_text()) == []
    ratios = [m for m in kept if m["unit"] == "1"]
    doubled = [
        Metric(**{**m, "value": m["value"] * (0.5 if m["more_is_better"] else 2.0)}) for m in ratios
    ]
    assert len(gate(doubled, BASELINE.read_text())) == len(ratios) > 20


def test_table_shows_value_unit_target_and_note():
    metrics = [
        Metric("ratio", "bar", 0.5, "1", target=1.0),
        Metric("rate", "bar", 19.0, "/s", target=20, more_is_better=True, note="slow"),
    ]
    *_, ratio, rate = as_markdown(metrics).splitlines()
    assert ratio == "| ratio | bar | 0.5 | ≤ 1 | yes |"
    assert rate == "| rate | bar (slow) | 19 /s | ≥ 20 /s | **no** |"
