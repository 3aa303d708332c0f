"""The place of a run: who may write there, and what is said of one that cannot be used."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from zarr.storage import LocalStore

import jaxdeform as jd
from jaxdeform._apps.batch import run as runs
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._apps.batch.place import alone


@pytest.fixture
def manifest(files):
    row = {"mesh": "bar.off", "handles": "bend.json", "rigidity": 1}
    (files / "jobs.jsonl").write_text(json.dumps(row))
    return files / "jobs.jsonl"


def one_line(found) -> str:
    """Return the one line of a command that refuses its work."""
    code, out, err = found
    assert (code, out) == (2, ""), err
    assert err.count("\n") == 1, err
    return err


def test_two_commands_do_not_work_on_one_run(run, files, manifest):
    """On a new one as on one that was begun."""
    jobs = read_manifest(manifest)
    for begun in (False, True):
        with alone(str(files / "run")):
            if begun:
                runs.planned(str(files / "run"), jobs)
            before = sorted(files.rglob("*"))
            said = one_line(run("batch", manifest, "-o", files / "run"))
            assert f"{files}/run: another command works on this run: wait for its end" in said
            assert sorted(files.rglob("*")) == before
    code, out, _ = run("batch", "--status", files / "run")
    assert (code, out) == (0, "0 of 1 jobs done, 0 of them failed\n")


def test_a_killed_command_holds_nothing(files):
    place = str(files / "run")
    program = (
        "import sys, time; from jaxdeform._apps.batch.place import alone\n"
        "with alone(sys.argv[1]):\n    print('held', flush=True)\n    time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program, place], stdout=subprocess.PIPE) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == b"held\n"
            with pytest.raises(jd.InputError, match="another command works"), alone(place):
                pass
        finally:
            child.send_signal(signal.SIGKILL)
    with alone(place):
        pass


@pytest.mark.slow
def test_two_commands_at_once(files, manifest):
    """One does the work. The other says that it is done already, or by whom."""
    main = "from jaxdeform._apps.cli import main; main()"
    words = [sys.executable, "-c", main, "batch", str(manifest), "-o", str(files / "run")]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    both = [subprocess.Popen(words, **piped) for _ in range(2)]
    said = [one.communicate(timeout=600) for one in both]
    assert 0 in [one.returncode for one in both], said
    for one, (out, err) in zip(both, said, strict=True):
        if one.returncode:
            assert "another command works on this run" in one_line((one.returncode, out, err))
        else:
            assert "1 of 1 jobs done, 0 of them failed" in out


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no such signal to a process")
def test_an_interrupted_command_says_one_line(files, manifest):
    manifest.write_text("\n".join([manifest.read_text()] * 1000))
    main = "from jaxdeform._apps.cli import main; main()"
    words = [sys.executable, "-c", main, "batch", str(manifest), "-o", str(files / "run")]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **piped) as command:
        assert command.stdout is not None
        assert "dashboard" in command.stdout.readline()
        command.send_signal(signal.SIGINT)
        _, err = command.communicate(timeout=200)
    assert command.returncode == 130
    assert err == "jaxdeform: interrupted; no file was left half-written\n"


def test_workers_in_another_folder_find_the_run(run, files, manifest, monkeypatch):
    """Those of a scheduler were started elsewhere."""
    seen = []

    def go_on(root, jobs, settings, *rest):
        seen.append(settings.run)
        return False

    monkeypatch.setattr(runs, "go_on", go_on)
    monkeypatch.chdir(files)
    code, _, err = run("batch", manifest, "-o", "run", "--scheduler", "tcp://127.0.0.1:1")
    assert (code, err, seen) == (0, "", [str(files / "run")])


def test_a_folder_of_the_user_stays_as_it_is(run, files, manifest):
    before = sorted(files.rglob("*"))
    said = one_line(run("batch", manifest, "-o", files))
    assert "is a folder with other files in it: choose a new name" in said
    assert sorted(files.rglob("*")) == before


def test_a_full_disk_at_the_start_is_not_called_a_full_output(run, files, manifest, monkeypatch):
    async def fail(self, key, value, *rest):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(LocalStore, "set", fail)
    said = one_line(run("batch", manifest, "-o", files / "run"))
    assert f"{files}/run: its store cannot be read or written (No space left on device)" in said
    assert "run the same command again" in said
    monkeypatch.undo()
    runs.planned(str(files / "run"), read_manifest(manifest))


WRONG = {
    "": "give the folder of the run with -o",
    "{files}/bar.off": "bar.off: cannot be made (File exists): choose another folder",
    "{files}/bar.off/run": "cannot be made (Not a directory): choose another folder",
    "/proc/run": "/proc/run: cannot be made (",
    "memory://run": "the workers are other processes, with other memory: give a folder",
    "foo://x": "foo://x: cannot be reached (Protocol not known: foo): check the address",
}


@pytest.mark.parametrize("place", WRONG)
def test_a_place_that_cannot_be_used(run, files, manifest, place):
    if place.startswith("/proc") and not Path("/proc").is_dir():
        pytest.skip("there is no such folder")
    assert WRONG[place] in one_line(run("batch", manifest, "-o", place.format(files=files)))


@pytest.mark.parametrize(
    "error",
    [ImportError("Install s3fs to access S3"), OSError(-2, "Name or service not known")],
)
def test_an_address_that_cannot_be_reached(run, manifest, monkeypatch, error):
    import fsspec.core

    def fail(place):
        raise error

    monkeypatch.setattr(fsspec.core, "url_to_fs", fail)
    for words in ([manifest, "-o"], ["--status"]):
        said = one_line(run("batch", *words, "s3://bucket/run"))
        assert f"s3://bucket/run: cannot be reached ({error}): check the address" in said


DAMAGES = {
    "a group is gone": lambda store: (store / "mesh_0" / "zarr.json").unlink(),
    "an array is gone": lambda store: (store / "mesh_0" / "result" / "zarr.json").unlink(),
    "no JSON": lambda store: (store / "mesh_0" / "zarr.json").write_text("{"),
    "the root is no JSON": lambda store: (store / "zarr.json").write_text("{"),
    "no manifest": lambda store: (store / "manifest" / "c" / "0").unlink(),
    "a part of a chunk": lambda store: (store / "manifest" / "c" / "0").write_bytes(b"x"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_store_that_is_damaged(run, files, manifest, damage):
    runs.planned(str(files / "run"), read_manifest(manifest))
    DAMAGES[damage](files / "run" / "results.zarr")
    said = one_line(run("batch", "--status", files / "run"))
    assert f"{files}/run: its store cannot be read or written (" in said
    said = one_line(run("batch", "--export", files / "run", "-o", files / "out"))
    assert f"{files}/run: its store cannot be read or written (" in said
