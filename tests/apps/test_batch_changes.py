"""Files that change while a batch run is at work, or after it: no old answer, no mixed result."""

import json

import numpy as np
import pytest
from batch_runs import do_all
from helpers import lower_and_upper

import jaxdeform as jd
from jaxdeform._apps.batch import run as runs
from jaxdeform._apps.batch import store, summary
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._apps.batch.work import do
from jaxdeform._apps.batch.worker import WorkerSettings, run_block


@pytest.fixture
def jobs(files):
    """Return a function that reads a manifest of jobs on the bar; by default of one."""

    def jobs(*rows):
        usual = {"mesh": "bar.off", "rigidity": 1, "handles": "bend.json"}
        lines = [json.dumps(usual | row) for row in rows or [{"job": "bent"}]]
        (files / "jobs.jsonl").write_text("\n".join(lines))
        return read_manifest(files / "jobs.jsonl")

    return jobs


def test_a_worker_that_outlives_a_run_sees_other_content_under_the_same_names(files, jobs, bar):
    (job,) = jobs()
    low, high = lower_and_upper(bar)
    wide = jd.Mesh(bar.vertices * [2.0, 1.0, 1.0], bar.faces)
    lifted = [{"vertices": low.tolist()}, {"vertices": high[:9].tolist(), "translation": [0, 9, 0]}]
    before = do(job).vertices
    for change in (
        lambda: jd.save_mesh(files / "bar.off", wide),
        lambda: (files / "bend.json").write_text(json.dumps({"handles": lifted})),
    ):
        change()
        mesh = jd.load_mesh(files / "bar.off")
        handles, targets = jd.load_handles(files / "bend.json", mesh)
        want = jd.deform(jd.precompute(mesh, handles), targets, 1.0).vertices
        found = do(job).vertices
        np.testing.assert_array_equal(found, want)
        assert np.abs(found - before).max() > 1.0  # of a bar 151 long
        before = found


@pytest.mark.parametrize("name", ["bar.off", "bend.def"])
def test_a_file_that_changes_while_the_run_is_at_work_ends_it(files, jobs, name):
    own = jobs({"handles": "bend.sel"})
    root = runs.planned(str(files / "run"), own)
    text = (files / name).read_text()
    (files / name).write_text(
        f"{text}\n" if name == "bar.off" else text.replace("0 0 75.5", "0 0 70")
    )
    with pytest.raises(jd.InputError, match=rf"{name} has changed since it was begun: restore it"):
        do_all(files / "run", own)
    ((block, done),) = store.blocks(root, own)
    with pytest.raises(jd.InputError, match=rf"{name} has changed since it was begun: restore it"):
        run_block(block, WorkerSettings(str(files / "run"), "a", 3, 600.0, False))
    assert not done
    assert summary.count(root, own).done == 0
    (files / name).write_text(text)
    assert summary.count(do_all(files / "run", own), own) == (1, 0, 1)


def test_a_file_that_is_gone_ends_the_run(files, jobs):
    own = jobs()
    root = runs.planned(str(files / "run"), own)
    (files / "bend.json").unlink()
    ((block, _),) = store.blocks(root, own)
    with pytest.raises(jd.InputError, match=r"bend\.json: cannot be read \(No such file"):
        run_block(block, WorkerSettings(str(files / "run"), "a", 3, 600.0, False))
    assert summary.count(root, own).done == 0


LIFT, FIT = {"translate": "0 0 1"}, {"poses": "bar.off", "rigidity": None}
HELD = {"fix": "v < 0.1", "move": "v > 0.9"}


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (LIFT | HELD | {"fix": "x < -500"}, "fix: 'x < -500' holds for no vertex"),
        (LIFT | HELD | {"move": "x < -500"}, "move: 'x < -500' holds for no vertex"),
        (LIFT | HELD | {"stiff": "x < -500: 1"}, "stiff: 'x < -500' holds for no vertex"),
        (LIFT | {"fix": "x < 500", "move": "x < 500"}, "fix and move both choose 722 vertices"),
        (FIT | HELD | {"fix": "x < -500"}, "fix: 'x < -500' holds for no vertex"),
        (FIT | HELD | {"move": "x < -500"}, "move: 'x < -500' holds for no vertex"),
    ],
)
def test_errors_name_the_column_and_no_option(files, jobs, own, message):
    own = jobs({"handles": None} | own)
    (error,) = store.errors_of(do_all(files / "run", own)).values()
    assert error.startswith(message)
    assert "--" not in error


def test_a_motion_that_is_missing_beside_its_handles_is_named_at_once(files, jobs):
    (files / "bend.def").unlink()
    with pytest.raises(jd.InputError, match=r"row 1, handles: there is no file .*bend\.def"):
        jobs({"handles": "bend.sel"})
