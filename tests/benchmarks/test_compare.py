"""The comparison of two source trees."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import compare, workloads

TREE = Path(compare.__file__).parents[1]


def test_sides_alternate_and_so_does_the_one_that_goes_first():
    order = []
    answers = compare.in_turns(
        3, lambda: order.append("old") or 1, lambda: order.append("new") or 2
    )
    assert order == ["old", "new", "new", "old", "old", "new"]
    assert answers == ([1, 1, 1], [2, 2, 2])


def test_ratio_is_the_median_over_the_rounds_so_that_a_change_of_pace_cancels():
    # In the last rounds the machine is ten times slower for both.
    row = compare.Row("job", [1.0, 1.0, 10.0, 10.0], [0.5, 0.5, 5.0, 5.0])
    assert "| 0.500 | 0.500 to 0.500 |" in row.as_markdown()


def test_jobs_have_names_of_their_own():
    names = [job.name for job in compare.JOBS] + list(compare.FIRST)
    assert len(set(names)) == len(names)
    assert {job.load for job in compare.JOBS} | set(compare.FIRST.values()) <= set(compare.LOADS)


def test_a_tree_compared_with_itself_does_the_same(tmp_path):
    compare.write(workloads.bar(), tmp_path / "bar.npz")
    job = next(x for x in compare.JOBS if x.name == "precompute, bar")
    old, new = compare.Child(TREE), compare.Child(TREE)
    try:
        row = compare.compare_job(job, tmp_path / "bar.npz", old, new, rounds=1)
    finally:
        old.close()
        new.close()
    assert np.isfinite(row.old + row.new).all()
    assert min(row.old + row.new) > 0
    assert row.note == ""


def test_a_tree_that_is_not_the_one_imported_is_refused(tmp_path):
    with pytest.raises(RuntimeError, match="jaxdeform came from"):
        compare.Child(tmp_path)
