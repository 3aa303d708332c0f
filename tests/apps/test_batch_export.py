"""Results of a batch run as meshes: nothing is written over, and one bad job keeps no other."""

import json
import os

import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._apps.batch import run as runs
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._apps.batch.work import Done
from jaxdeform._apps.results import rescue_of

NAMES = ["bar", "other", "fit"]


@pytest.fixture
def done(files, bar):
    """Return a folder with a run that is done: two deformations that lift a bar, and a fit."""
    jd.save_mesh(files / "bar.ply", bar)
    usual = {"mesh": "bar.ply", "handles": "bend.json"}
    poses = [{}, {}, {"poses": "bar.off"}]
    rows = [usual | {"job": name} | own for name, own in zip(NAMES, poses, strict=True)]
    (files / "jobs.jsonl").write_text("\n".join(map(json.dumps, rows)))
    jobs = read_manifest(files / "jobs.jsonl")
    root = runs.planned(str(files / "run"), jobs)
    write(root, jobs, lambda row: bar.vertices + np.array([0, 0, row]))
    return files


def write(root, jobs, vertices_of) -> None:
    for block, _ in list(store.blocks(root, jobs)):
        results = [
            Done(vertices_of(row), np.full(722, 1.0 + row), 1.0, np.nan, 1, 0, "converged", 0.1)
            for row in block.rows
        ]
        store.write(root, block, results)


def test_meshes_are_those_of_the_run(run, done, bar):
    code, out, err = run("batch", "--export", done / "run", "-o", done / "out")
    assert (code, err) == (0, "")
    assert out == f"wrote 3 meshes to {done}/out\n"
    for row, lift in enumerate([0, 1, 0]):  # a fit has the mesh at rest
        pose = jd.load_mesh(done / "out" / f"{NAMES[row]}.ply")
        np.testing.assert_array_equal(pose.vertices, bar.vertices + np.array([0, 0, lift]))
        np.testing.assert_array_equal(jd.load_rigidity(pose.source.path), np.full(722, 1.0 + row))


def test_a_mesh_that_has_changed_is_refused(run, done, bar):
    """The vertices of the run with the faces of another file would be no mesh of either."""
    jd.save_mesh(done / "bar.ply", jd.Mesh(bar.vertices, bar.faces[::-1]))
    code, out, err = run("batch", "--export", done / "run", "-o", done / "out")
    assert (code, out) == (2, "")
    assert "bar.ply has changed since it was begun: restore it" in err
    assert os.listdir(done / "out") == []


def test_no_file_that_the_run_reads_is_written_over(run, done):
    before = {path: path.read_bytes() for path in done.iterdir() if path.is_file()}
    code, out, err = run("batch", "--export", done / "run", "-o", done)
    assert (code, out) == (2, "")
    assert f"{done}/bar.ply: is {done}/bar.ply, which the run reads: give another folder" in err
    assert {path: path.read_bytes() for path in done.iterdir() if path.is_file()} == before
    (done / "out").mkdir()
    (done / "out" / "fit.ply").symlink_to(done / "bar.ply")
    code, out, err = run("batch", "--export", done / "run", "-o", done / "out")
    assert (code, out) == (2, "")
    assert f"{done}/out/fit.ply: is {done}/bar.ply, which the run reads" in err
    assert os.listdir(done / "out") == ["fit.ply"]
    # What a format cannot hold goes beside it.
    (done / "out" / "fit.ply").rename(done / "out" / "fit.rescued.ply")
    code, _, err = run("batch", "--export", done / "run", "-o", done / "out", "--format", "stl")
    assert code == 2
    assert f"{done}/out/fit.rescued.ply: is {done}/bar.ply" in err


def test_rescued_results_of_two_jobs_are_two_files(tmp_path):
    """A job's name may have points in it."""
    for out, rescue in {"a.1.stl": "a.1.rescued.ply", "a.2.stl.gz": "a.2.rescued.ply"}.items():
        assert rescue_of(tmp_path / out) == tmp_path / rescue


def test_a_job_that_cannot_be_written_is_named_and_the_others_are(run, done, bar):
    root, jobs = store.find(str(done / "run")), read_manifest(done / "jobs.jsonl")
    write(root, jobs, lambda row: bar.vertices * (1e300 if row == 0 else 1.0))
    (done / "out" / "fit.ply").mkdir(parents=True)
    code, out, err = run("batch", "--export", done / "run", "-o", done / "out")
    assert code == 1
    assert out == f"wrote 1 meshes to {done}/out; 2 could not be written\n"
    large, folder = err.splitlines()
    assert "out/bar.ply: not written, because load_mesh would refuse it" in large
    assert "out/fit.ply: is a folder" in folder
    assert jd.load_mesh(done / "out" / "other.ply").n_vertices == 722
