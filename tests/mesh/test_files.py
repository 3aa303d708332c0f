"""Files: round trips, and what is on disk stays whole."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest
from helpers import replaced

import jaxdeform as jd
from jaxdeform._mesh.files import check_output, write_atomically


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".OFF"])
def test_a_written_mesh_is_read_back_bit_for_bit(tmp_path, odd, suffix):
    jd.save_mesh(tmp_path / f"m{suffix}", odd)
    back = jd.load_mesh(tmp_path / f"m{suffix}")
    assert back.vertices.tobytes() == odd.vertices.tobytes()
    np.testing.assert_array_equal(back.faces, odd.faces)


def test_rigidity_goes_with_a_ply(tmp_path, odd):
    values = np.random.default_rng(1).random(8)
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd, vertices=odd.vertices + 1, rigidity=values)
    assert jd.load_rigidity(path).tobytes() == values.tobytes()
    np.testing.assert_array_equal(jd.load_mesh(path).vertices, odd.vertices + 1)
    jd.save_mesh(path, odd, rigidity=3)
    np.testing.assert_array_equal(jd.load_rigidity(path), np.full(8, 3.0))
    jd.save_mesh(path, odd)
    with pytest.raises(jd.InputError, match="no property 'rigidity'"):
        jd.load_rigidity(path)
    with pytest.raises(jd.InputError, match=r"\.ply files only"):
        jd.load_rigidity(tmp_path / "m.off")


def test_missing_files_and_folders(tmp_path):
    (tmp_path / "folder.off").mkdir()
    for name in ("missing.off", "folder.off", "missing/x.ply"):
        with pytest.raises(jd.InputError, match="cannot be read"):
            jd.load_mesh(tmp_path / name)


def test_a_failing_write_leaves_the_old_file(tmp_path, odd, monkeypatch):
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd)
    before = path.read_bytes()

    def half(error):
        def write(name):
            Path(name).write_bytes(before[:50])
            raise error

        return write

    with pytest.raises(jd.InputError, match="No space left on device"):
        write_atomically(path, half(OSError(28, "No space left on device")))
    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write_atomically(path, half(error()))
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(18, "no link")))
        with pytest.raises(jd.InputError, match="no link"):
            jd.save_mesh(path, odd, vertices=odd.vertices + 1)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["m.ply"]


def test_bad_arguments_leave_the_old_file(tmp_path, odd):
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd)
    before = path.read_bytes()
    nan = replaced(odd.vertices, (3, 0), np.nan)
    for message, settings_ in {
        r"vertices have shape \(7, 3\)": {"vertices": odd.vertices[1:]},
        "vertex 3 is .*nan": {"vertices": nan},
        r"rigidity has shape \(2,\)": {"rigidity": [1.0, 2.0]},
    }.items():
        with pytest.raises(jd.InputError, match=message):
            jd.save_mesh(path, odd, **settings_)
    with pytest.raises(jd.InputError, match="only PLY carries rigidity"):
        jd.save_mesh(tmp_path / "m.off", odd, rigidity=1.0)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["m.ply"]


def test_places_that_cannot_be_written(tmp_path, odd):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "file").write_text("x")
    for name in ("missing/m.ply", "file/m.ply", "folder.ply", "m.xyz"):
        for door in (lambda path: jd.save_mesh(path, odd), check_output):
            with pytest.raises(jd.InputError, match=name):
                door(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.ply"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission(tmp_path, odd):
    tmp_path.chmod(0o555)
    for door in (lambda path: jd.save_mesh(path, odd), check_output):
        with pytest.raises(jd.InputError, match=r"m\.ply"):
            door(tmp_path / "m.ply")
    tmp_path.chmod(0o755)


def test_a_new_file_has_the_usual_permissions_and_an_old_one_keeps_its_own(tmp_path, odd):
    (tmp_path / "plain").touch()
    path = tmp_path / "m.off"
    jd.save_mesh(path, odd)
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    path.chmod(0o640)
    jd.save_mesh(path, odd)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
