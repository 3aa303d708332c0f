"""A batch run: the results are those of deform, and nothing is lost or done twice."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import zarr
from batch_runs import do_all, settings
from zarr.storage import LocalStore

import jaxdeform as jd
from jaxdeform._apps.batch import run as runs
from jaxdeform._apps.batch import store, summary
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._apps.batch.worker import run_block

KILLS = int(os.environ.get("JAXDEFORM_KILLS", "20"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a plate, a broken mesh, and a manifest of 14 jobs, two of them bad."""
    folder = tmp_path_factory.mktemp("batch")
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(7.0), np.arange(4.0)))
    corner = np.flatnonzero((x < 6) & (y < 3))
    halves = [corner, corner + 1, corner + 8], [corner, corner + 8, corner + 7]
    faces = np.concatenate([np.stack(half, 1) for half in halves])
    jd.save_mesh(folder / "plate.off", jd.Mesh(np.stack([x, y, 0.1 * x * y], 1), faces))
    (folder / "broken.off").write_text("OFF\n3 1 0\n0 0\n")
    rows = [job(k, k / 4, 0.05 * (k + 1)) for k in range(12)]
    rows += [job("broken", 1, 1) | {"mesh": "broken.off"}]
    rows += [job("nothing", 1, 1) | {"fix": "x < -5"}]
    write(folder / "jobs.jsonl", rows)
    return folder


def job(name, lift: float, rigidity: float) -> dict:
    held = {"mesh": "plate.off", "fix": "x < 0.5", "move": "x > 5.5"}
    return held | {"job": f"job {name}", "translate": [0, 0, lift], "rigidity": rigidity}


def write(path, rows) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


@pytest.fixture(scope="module")
def jobs(folder):
    return read_manifest(folder / "jobs.jsonl")


@pytest.fixture(scope="module")
def unbroken(folder, jobs):
    return contents(do_all(folder / "unbroken", jobs))


def contents(root) -> dict:
    """Return all arrays but the times that the jobs took."""
    groups = [(name, root[name]) for name in root if name.startswith("mesh_")]
    kept = {
        f"{name}/{field}": group[field][:]
        for name, group in groups
        for field in group
        if field != "seconds"
    }
    return kept | {"begun": list(root["started"])}


def check_same(got: dict, want: dict) -> None:
    assert got.keys() == want.keys()
    for name, values in want.items():
        np.testing.assert_array_equal(got[name], values, err_msg=name)


def test_the_results_are_those_of_deform(folder, jobs, unbroken):
    mesh = jd.load_mesh(folder / "plate.off")
    x = mesh.vertices[:, 0]
    handles = np.flatnonzero((x < 0.5) | (x > 5.5))
    problem = jd.precompute(mesh, handles)
    assert unbroken["mesh_0/row"].tolist() == [13, *range(12)]
    for place, row in enumerate(unbroken["mesh_0/row"][1:], 1):
        lift = np.outer(x[handles] > 5.5, [0.0, 0.0, row / 4])
        out = jd.deform(problem, mesh.vertices[handles] + lift, 0.05 * (row + 1))
        np.testing.assert_array_equal(unbroken["mesh_0/vertices"][place], out.vertices)
        assert unbroken["mesh_0/energy"][place] == out.energy[-1]
    np.testing.assert_array_equal(unbroken["mesh_0/faces"], mesh.faces)


def test_bad_jobs_are_named_and_end_no_other(folder, jobs, unbroken):
    root = store.find(str(folder / "unbroken"))
    assert summary.count(root, jobs) == (14, 2, 14)
    table = summary.table(root, jobs)
    assert table["job"] == [job.job for job in jobs]
    assert table["result"] == [*["converged"] * 12, "failed", "failed"]
    assert "the file is truncated or damaged" in table["error"][12]
    assert "'x < -5' holds for no vertex" in table["error"][13]
    assert table["error"][:12] == [None] * 12


@pytest.mark.slow
def test_every_write_may_fail(folder, jobs, unbroken, monkeypatch):
    """The n-th write of the store fails, for each n: the same command then ends the same."""
    write = LocalStore.set
    left = [0]

    async def fail_once(self, key, value, *rest):
        left[0] -= 1
        if left[0] == 0:
            raise OSError(28, "No space left on device")
        return await write(self, key, value, *rest)

    monkeypatch.setattr(LocalStore, "set", fail_once)
    few = [jobs[0], jobs[1], jobs[12]]
    left[0] = 0
    want = contents(do_all(folder / "few", few))
    failed = 0
    for n in range(1, 200):
        left[0] = n
        try:
            do_all(folder / f"failing {n}", few)
        except OSError:
            failed += 1
        else:
            break
        left[0] = 0
        wait_for_writes(folder / f"failing {n}")
        check_same(contents(do_all(folder / f"failing {n}", few, "b")), want)
    assert failed == n - 1 >= 20


def wait_for_writes(run) -> None:
    """In this process Zarr's other writes go on for a moment after one has failed."""
    before = None
    while (now := sorted(run.rglob("*"))) != before:
        before = now
        time.sleep(0.1)


def test_another_run_is_refused(folder, jobs, unbroken):
    for run, own, message in [
        ("unbroken", jobs[:-1], "begun with another manifest"),
        (".", jobs, "is a folder with other files in it"),
    ]:
        with pytest.raises(jd.InputError, match=message):
            runs.planned(str(folder / run), own)
    plate = folder / "plate.off"
    text = plate.read_text()
    plate.write_text(text + "# changed\n")
    try:
        with pytest.raises(jd.InputError, match=r"plate\.off has changed since it was begun"):
            runs.planned(str(folder / "unbroken"), jobs)
    finally:
        plate.write_text(text)
    zarr.open_group(folder / "mine" / "results.zarr", mode="w")
    with pytest.raises(jd.InputError, match="holds a Zarr store that is no run"):
        runs.planned(str(folder / "mine"), jobs)


def test_a_job_that_ends_its_workers_is_given_up(folder, jobs):
    """As worker.py finds the notes where workers died at the first job of a block."""
    root = runs.planned(str(folder / "poisoned"), jobs[:3])
    block, _ = next(store.blocks(root, jobs[:3]))
    counts = {str(block.rows[0]): 2}
    store.note(root, block, {"session": "a", "counts": counts})
    run_block(block, settings(folder / "poisoned"))
    table = summary.table(root, jobs[:3])
    assert "it ended 3 workers" in table["error"][block.rows[0]]
    assert sorted(table["result"]) == ["converged", "converged", "failed"]


def test_an_address_of_fsspec(folder, jobs, unbroken):
    """Another store than a folder, here in memory."""
    check_same(contents(do_all("memory://runs/one", jobs)), unbroken)
    assert not summary.has_tables("memory://runs/one", False)
    summary.write_tables("memory://runs/one", {"job": ["a"]}, False)
    assert summary.has_tables("memory://runs/one", False)
    assert not summary.has_tables("memory://runs/one", True)
    summary.write_tables("memory://runs/one", {"job": ["a"]}, True)
    assert summary.tables("memory://runs/one", True) == [
        "memory://runs/one/summary.parquet",
        "memory://runs/one/summary.csv",
    ]
    assert summary.has_tables("memory://runs/one", True)


# ---------------------------------------------------------------- the command, in processes


def command(*words) -> list[str]:
    main = "from jaxdeform._apps.cli import main; main()"
    return [sys.executable, "-c", main, "batch", *map(str, words)]


@pytest.mark.slow
def test_the_command(folder, unbroken, tmp_path):
    ran = subprocess.run(
        command(folder / "jobs.jsonl", "-o", tmp_path / "run", "--csv"),
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "14 of 14 jobs done, 2 of them failed" in ran.stdout, ran.stderr
    assert "dashboard: http://127.0.0.1:" in ran.stdout
    assert ran.returncode == 1
    check_same(contents(store.find(str(tmp_path / "run"))), unbroken)
    assert len((tmp_path / "run" / "summary.csv").read_text().splitlines()) == 15
    again = subprocess.run(
        command(folder / "jobs.jsonl", "-o", tmp_path / "run"), capture_output=True, text=True
    )
    assert "workers" not in again.stdout  # there was nothing to do
    meshes = subprocess.run(
        command("--export", tmp_path / "run", "-o", tmp_path / "meshes"),
        capture_output=True,
        text=True,
    )
    assert "wrote 12 meshes" in meshes.stdout, meshes.stderr
    pose = jd.load_mesh(tmp_path / "meshes" / "job 3.ply").vertices
    np.testing.assert_array_equal(pose, unbroken["mesh_0/vertices"][4])


@pytest.mark.slow
def test_killed_at_any_moment(folder, jobs, tmp_path):
    """The command, or one of its processes, is killed; the same command ends as if it was not.

    JAXDEFORM_KILLS=100 makes it 100 times.
    """
    rng = np.random.default_rng(7)
    rows = [job(k, (k % 20) / 10, 0.05 * (1 + k % 7)) for k in range(200)]
    write(folder / "many.jsonl", rows)
    many = read_manifest(folder / "many.jsonl")
    want = contents(do_all(tmp_path / "unbroken", many))
    killed, number = 0, 0
    while killed < KILLS:
        run = tmp_path / f"run {number}"
        words = command(folder / "many.jsonl", "-o", run, "--workers", 2)
        with (tmp_path / "out").open("w") as out:
            main = subprocess.Popen(words, stdout=out, stderr=out)
        try:
            main.wait(timeout=float(rng.uniform(0.0, 12.0)))
        except subprocess.TimeoutExpired:
            victims = [psutil.Process(main.pid)]
            if rng.random() < 0.5:
                victims = victims[0].children(recursive=True) or victims
            victim = victims[rng.integers(len(victims))]
            victim.send_signal(signal.SIGKILL)
            killed += 1
            main.wait(timeout=600)
        if main.returncode == 0:
            check_same(contents(store.find(str(run))), want)
            number += 1
        else:  # nothing but the kill ends it
            assert main.returncode == -signal.SIGKILL or "run the same command again" in (
                (tmp_path / "out").read_text()
            )
            time.sleep(0.2)
    last = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert last.returncode == 0, last.stderr
    check_same(contents(store.find(str(run))), want)


def mounted(place: Path, size: str) -> bool:
    """Mount a disk of this size, or enlarge it; False where that is not allowed."""
    place.mkdir(exist_ok=True)
    option = f"{'remount,' if place.is_mount() else ''}size={size}"
    words = ["mount", "-t", "tmpfs", "-o", option, "tmpfs", str(place)]
    with contextlib.suppress(OSError):
        return subprocess.run(words, capture_output=True).returncode == 0
    return False


@pytest.mark.slow
def test_a_disk_that_is_full(folder, tmp_path):
    """Nothing is lost: the same command goes on when there is room."""
    disk, rows = tmp_path / "disk", [job(k, (k % 20) / 10, 0.05) for k in range(200)]
    write(folder / "full.jsonl", rows)
    want = contents(do_all(tmp_path / "unbroken", read_manifest(folder / "full.jsonl")))
    if not mounted(disk, "200k"):
        pytest.skip("no disk can be mounted here")
    try:
        words = command(folder / "full.jsonl", "-o", disk / "run", "--workers", 1)
        ran = subprocess.run(words, capture_output=True, text=True, timeout=600)
        assert ran.returncode == 2
        assert "No space left on device" in ran.stderr
        assert "run the same command again" in ran.stderr
        assert mounted(disk, "64m")
        ran = subprocess.run(words, capture_output=True, text=True, timeout=600)
        assert ran.returncode == 0, ran.stderr
        check_same(contents(store.find(str(disk / "run"))), want)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
def test_a_job_without_end_is_given_up(folder, tmp_path):
    """Cells of 400 rings on a large mesh: the time limit ends the worker, and then the job."""
    n = 150
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(float(n)), np.arange(float(n))))
    corner = np.flatnonzero((x < n - 1) & (y < n - 1))
    faces = [[corner, corner + 1, corner + n + 1], [corner, corner + n + 1, corner + n]]
    sheet = jd.Mesh(np.stack([x, y, 0 * x], 1), np.concatenate([np.stack(f, 1) for f in faces]))
    jd.save_mesh(folder / "sheet.off", sheet)
    endless = job("endless", 1, 1) | {"mesh": "sheet.off", "rings": 400}
    write(folder / "endless.jsonl", [job(1, 1, 1), endless, job(2, 2, 1)])
    words = command(folder / "endless.jsonl", "-o", tmp_path / "run", "--csv", "--tries", 2)
    ran = subprocess.run([*words, "--time-limit", "40"], capture_output=True, text=True)
    assert "3 of 3 jobs done, 1 of them failed" in ran.stdout, ran.stderr
    assert "it ended 2 workers" in (tmp_path / "run" / "summary.csv").read_text()
