"""Writing: what is on disk stays whole, and keeps its permissions and links."""

import os
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import jaxdeform as jd
from jaxdeform._mesh.writing import write_atomically

pytestmark = pytest.mark.skipif(os.name == "nt", reason="permissions and links of POSIX")


def test_a_new_file_has_the_usual_permissions_and_an_old_one_keeps_its_own(tmp_path, odd):
    (tmp_path / "plain").touch()
    path = tmp_path / "m.off"
    jd.save_mesh(path, odd)
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    path.chmod(0o640)
    jd.save_mesh(path, odd)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_the_mask_of_the_process_is_never_set(tmp_path, odd, monkeypatch):
    old = os.umask(0o027)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "umask", lambda _: pytest.fail("all threads see that"))
            jd.save_mesh(tmp_path / "m.off", odd)
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "m.off").stat().st_mode) == 0o640


def test_a_link_stays_a_link(tmp_path, odd):
    (tmp_path / "data").mkdir()
    link, target = tmp_path / "link.off", tmp_path / "data" / "m.off"
    link.symlink_to(Path("data", "m.off"))
    for pose in (odd.vertices, odd.vertices + 1):  # first it names nothing
        jd.save_mesh(link, odd, vertices=pose)
        assert link.is_symlink()
        assert not target.is_symlink()
        assert jd.load_mesh(target).vertices.tobytes() == pose.tobytes()
    assert sorted(os.listdir(tmp_path)) == ["data", "link.off"]
    assert os.listdir(tmp_path / "data") == ["m.off"]


def test_what_is_read_only_or_no_file_is_refused(tmp_path, odd):
    path = tmp_path / "m.off"
    path.write_text("precious")
    path.chmod(0o444)
    (tmp_path / "to_it.off").symlink_to(path)
    (tmp_path / "null.off").symlink_to("/dev/null")
    (tmp_path / "loop.off").symlink_to("loop.off")
    os.mkfifo(tmp_path / "pipe.off")
    for name, message in {
        "m.off": "is read-only: make it writeable",
        "to_it.off": "is read-only",
        "null.off": "is a pipe or a device",
        "pipe.off": "is a pipe or a device",
        "loop.off": "cannot write there",
    }.items():
        with pytest.raises(jd.InputError, match=f"{name}: {message}"):
            jd.save_mesh(tmp_path / name, odd)
    assert path.read_text() == "precious"
    assert len(os.listdir(tmp_path)) == 5


def test_the_content_is_on_the_disk_before_the_name(tmp_path, monkeypatch):
    calls = []
    fsync, replace = os.fsync, os.replace

    def synced(handle):
        calls.append(("fsync", stat.S_ISDIR(os.fstat(handle).st_mode), os.fstat(handle).st_size))
        fsync(handle)

    def renamed(old, new):
        calls.append(("rename",))
        replace(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    write_atomically(tmp_path / "a", b"content")
    assert [call[:2] for call in calls] == [("fsync", False), ("rename",), ("fsync", True)]
    assert calls[0][2] == 7


STOP = """
import os, signal, sys
from pathlib import Path
from jaxdeform._mesh.writing import write_atomically
def stop(_):
    print("stopped", flush=True)
    signal.pause()
os.fsync = stop
write_atomically(Path(sys.argv[1]), b"content")
"""


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_is_not(tmp_path):
    command = [sys.executable, "-c", STOP, tmp_path / "a"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "stopped\n"
        (left,) = os.listdir(tmp_path)
        assert left != "a"
        write_atomically(tmp_path / "b", b"other")
        assert sorted(os.listdir(tmp_path)) == sorted([left, "b"])
        process.send_signal(signal.SIGKILL)
    write_atomically(tmp_path / "b", b"other")
    assert os.listdir(tmp_path) == ["b"]


def test_threads_do_not_remove_each_other_s_files(tmp_path):
    errors = []

    def work(k):
        try:
            for round_ in range(40):
                write_atomically(tmp_path / f"{k % 4}", f"{k % 4} {round_}".encode())
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    contents = {name: (tmp_path / name).read_text().split()[0] for name in os.listdir(tmp_path)}
    assert contents == {str(k): str(k) for k in range(4)}
