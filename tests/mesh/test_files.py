"""Files: round trips, compressed ones, what is no file."""

import gzip
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from helpers import CASES, replaced, tetrahedron

import jaxdeform as jd
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._mesh.files import check_output


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


@pytest.mark.parametrize("value", ["nan", "-1.0", "inf", "-inf"])
def test_a_rigidity_that_is_none_names_file_and_vertex(tmp_path, value):
    path = tmp_path / "m.ply"
    header = ["ply", "format ascii 1.0", "element vertex 3"]
    header += [f"property double {name}" for name in ("x", "y", "z", "rigidity")]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    rows = ["0 0 0 2", "1 0 0 0", f"0 1 0 {value}", "3 0 1 2"]
    path.write_text("\n".join([*header, *rows, ""]))
    with pytest.raises(jd.InputError, match=rf"m\.ply: rigidity is {value} at vertex 2: it must"):
        jd.load_rigidity(path)
    path.write_text(path.read_text().replace(value, "7.5"))
    assert jd.load_rigidity(path).tolist() == [2, 0, 7.5]


def test_missing_files_and_folders(tmp_path):
    (tmp_path / "folder.off").mkdir()
    for name in ("missing.off", "folder.off", "missing/x.ply"):
        with pytest.raises(jd.InputError, match="cannot be read"):
            jd.load_mesh(tmp_path / name)


def test_a_failing_write_leaves_the_old_file(tmp_path, odd, monkeypatch):
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd)
    before = path.read_bytes()

    def failing(error):
        def fail(*_):
            raise error

        return fail

    def save():
        jd.save_mesh(path, odd, vertices=odd.vertices + 1)

    for name in ("fsync", "replace", "open"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, failing(OSError(28, "No space left on device")))
            with pytest.raises(jd.InputError, match="No space left on device"):
                save()
    for error in (RuntimeError, KeyboardInterrupt):
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", failing(error()))
            with pytest.raises(error):
                save()
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
        "rigidity is nan: it must be": {"rigidity": np.nan},
        "rigidity is -1.0 at vertex 7": {"rigidity": replaced(np.ones(8), 7, -1.0)},
        "rigidity is inf at vertex 2": {"rigidity": replaced(np.ones(8), 2, np.inf)},
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


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl"])
def test_compressed_files(tmp_path, bar, suffix):
    plain, packed = tmp_path / f"m{suffix}", tmp_path / f"m{suffix}.GZ"
    jd.save_mesh(plain, bar)
    jd.save_mesh(packed, bar)
    assert gzip.decompress(packed.read_bytes()) == plain.read_bytes()
    # Files may be put together.
    whole = plain.read_bytes()
    packed.write_bytes(gzip.compress(whole[:999]) + gzip.compress(whole[999:]))
    assert jd.load_mesh(packed) == jd.load_mesh(plain)
    if suffix == ".ply":
        jd.save_mesh(packed, bar, rigidity=2.0)
        np.testing.assert_array_equal(jd.load_rigidity(packed), np.full(722, 2.0))


def test_damaged_compressed_files(tmp_path, odd):
    path = tmp_path / "m.off.gz"
    jd.save_mesh(path, odd)
    data = path.read_bytes()
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(jd.InputError, match=r"cannot be decompressed|is empty"):
            jd.load_mesh(path)
    path.write_bytes(b"OFF\n")
    with pytest.raises(jd.InputError, match="cannot be decompressed"):
        jd.load_mesh(path)
    with pytest.raises(jd.InputError, match=r"unknown suffix ''"):
        jd.load_mesh(tmp_path / "m.gz")


def test_a_file_made_to_fill_the_memory_is_refused(tmp_path):
    path = tmp_path / "m.obj.gz"
    path.write_bytes(gzip.compress(bytes(30_000_000)))
    tracemalloc.start()
    with pytest.raises(jd.InputError, match="more than 200 times as long when decompressed"):
        jd.load_mesh(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # The result, and a copy of it while it is put together.
    assert peak < 3 * 200 * path.stat().st_size


def _load_handles(path):
    return jd.load_handles(path, jd.Mesh(*tetrahedron()))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has none")
@pytest.mark.parametrize(
    ("door", "suffix"),
    [
        *((door, ".ply") for door in (jd.load_mesh, jd.load_rigidity, jd.inspect, jd.repair)),
        (_load_handles, ".json"),
        (_load_handles, ".sel"),
        (jd.load_skeleton, ".tgf"),
        *((read_manifest, suffix) for suffix in (".csv", ".jsonl", ".parquet")),
    ],
)
def test_pipes_and_devices_are_refused(tmp_path, door, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    pipe, zero = tmp_path / f"pipe{suffix}", tmp_path / f"zero{suffix}"
    os.mkfifo(pipe)
    zero.symlink_to("/dev/zero")
    for path in (pipe, zero):
        with pytest.raises(jd.InputError, match="it is a pipe or a device"):
            door(path)


@pytest.mark.skipif(not Path("/proc/version").exists(), reason="Linux has it")
def test_files_that_the_system_makes_as_they_are_read_are_not_read(tmp_path):
    """As /proc/kmsg, where reading can wait for ever."""
    (tmp_path / "system.ply").symlink_to("/proc/version")
    with pytest.raises(jd.InputError, match="is empty"):
        jd.load_mesh(tmp_path / "system.ply")


@pytest.mark.parametrize("door", [jd.load_mesh, jd.inspect, check_output])
def test_a_name_that_no_file_can_have(tmp_path, door):
    for name in (f"{tmp_path}/a\0b.ply", f"{tmp_path}/{'a' * 5000}.ply"):
        with pytest.raises(jd.InputError) as error:
            door(name)
        assert "\0" not in str(error.value)
        assert len(str(error.value)) <= 1000


def test_nothing_of_a_file_reaches_the_terminal_unescaped(tmp_path):
    evil = "\x1b]0;title\x07\x9b31m\u202e"
    files = {
        "m.obj": f"v 0 0 0\n{evil} 1\n",
        "m.off": f"OFF\n1 1 0\n{evil}\n3 0 0 0\n",
        "m.ply": f"ply\nformat {evil} 1.0\nelement vertex 1\nproperty int x\nproperty int y\n"
        "property int z\nend_header\n",
        "n.ply": f"ply\nformat ascii 1.0\nelement vertex 1\nelement {evil}{'a' * 9999} 5\n"
        "property int x\nend_header\n",
        "m.stl": f"solid\nvertex {evil}\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(jd.InputError) as error:
            jd.load_mesh(tmp_path / name)
        assert str(error.value).isprintable()
        assert len(str(error.value)) <= 1000


def test_nothing_of_a_file_reaches_the_terminal_unescaped_in_a_warning(tmp_path, recwarn):
    """What another format cannot hold is named as the file names it."""
    evil = "\x1b]0;title\x07\x9b31m\u202e"
    files = {
        "m.ply": f"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        f"property float z\nproperty float {evil}\nelement face 1\nproperty list uchar int "
        f"vertex_indices\nproperty int {evil}\nelement {evil} 1\nproperty int a\nend_header\n"
        "0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2 7\n5\n",
        "m.obj": f"v 0 0 0\nv 1 0 0\nv 0 1 0\ng {evil}\no {evil}\nusemtl {evil}\nf 1 2 3\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        jd.save_mesh(tmp_path / f"{name}.off", jd.load_mesh(tmp_path / name))
    assert len(recwarn.list) == len(files)
    for warning in recwarn.list:
        assert str(warning.message).isprintable()


def test_stl_says_what_single_precision_loses(tmp_path):
    """At 5e5, float32 steps by 1/32."""
    path = tmp_path / "m.stl"
    small = jd.shapes.square()
    far = np.array([5e5, 5e5, 0.0]) + 0.3
    for size, outcome in {0.01: "error", 1.0: "warning", 1e4: "nothing"}.items():
        mesh = jd.Mesh(small.vertices * size + far, small.faces)
        if outcome == "error":
            rounded = mesh.vertices.astype(np.float32)[mesh.faces].tolist()
            lost = sum(len(set(map(tuple, corners))) < 3 for corners in rounded)
            message = rf"not written: STL keeps single .* up to 0\.\d+ and {lost} faces collapse"
            with pytest.raises(jd.InputError, match=message):
                jd.save_mesh(path, mesh)
            assert not path.exists()
            continue
        if outcome == "warning":
            with pytest.warns(UserWarning, match=r"move by up to 0\.\d+ and the shortest edge is"):
                jd.save_mesh(path, mesh)
        else:
            jd.save_mesh(path, mesh)
        assert jd.load_mesh(path).n_faces == 8
    with pytest.raises(jd.InputError, match="not written: STL keeps single precision"):
        jd.save_mesh(path, small, vertices=small.vertices * 1e39)


TEXT_STL = CASES / "46_upper_crlf.stl"


@pytest.mark.parametrize("text", [True, False])
def test_an_stl_that_could_not_be_read_is_not_written(tmp_path, text):
    """A face with two corners in one place, at rest or in a pose."""
    path = tmp_path / "m.stl"
    mesh = jd.load_mesh(TEXT_STL) if text else jd.shapes.square()
    a, b, _ = mesh.faces[0]
    pose = replaced(mesh.vertices, a, mesh.vertices[b])
    both = [{a, b} <= set(face) for face in mesh.faces.tolist()]
    jd.save_mesh(path, mesh)
    before = path.read_bytes()
    message = rf"m\.stl: not written: {sum(both)} faces have two corners in one place \(face 0\)"
    with pytest.raises(jd.InputError, match=message):
        jd.save_mesh(path, mesh, vertices=pose)
    if not text:
        for door in (jd.save_mesh, check_output):
            with pytest.raises(jd.InputError, match=message):
                door(path, jd.Mesh(pose, mesh.faces))
    assert path.read_bytes() == before
    # Formats that share vertices hold it.
    jd.save_mesh(tmp_path / "m.off", mesh, vertices=pose)
    np.testing.assert_array_equal(jd.load_mesh(tmp_path / "m.off").vertices, pose)


@pytest.mark.parametrize("text", [True, False])
def test_vertices_that_an_stl_joins_are_told(tmp_path, text):
    """Two tetrahedra that touch with a corner in the pose."""
    path = tmp_path / "m.stl"
    v, f = tetrahedron()
    both = np.concatenate([v, tetrahedron([2, 0, 0])[0]])
    mesh = jd.Mesh(both, np.concatenate([f, f + 4]))
    if text:
        lines = ["solid"]
        for face in mesh.vertices[mesh.faces].tolist():
            corners = [f"vertex {x} {y} {z}" for x, y, z in face]
            lines += ["facet normal 0 0 1", "outer loop", *corners, "endloop", "endfacet"]
        path.write_text("\n".join([*lines, "endsolid"]))
        mesh = jd.load_mesh(path)
    jd.save_mesh(path, mesh, vertices=mesh.vertices + 0.5)  # apart, and nothing to tell
    shift = np.where(mesh.vertices[:, :1] >= 2, [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    with pytest.warns(UserWarning, match="one vertex of those in one place, so that 1 fewer come"):
        jd.save_mesh(path, mesh, vertices=mesh.vertices + shift)
    back = jd.load_mesh(path)
    assert (back.n_vertices, back.n_faces) == (7, 8)


def test_vertices_that_an_stl_leaves_out_are_told(tmp_path):
    v, f = tetrahedron()
    mesh = jd.Mesh(np.concatenate([[[9, 9, 9]], v]), f + 1)
    with pytest.warns(UserWarning, match="1 vertices without a face do not come back"):
        jd.save_mesh(tmp_path / "m.stl", mesh)
    assert jd.load_mesh(tmp_path / "m.stl").n_vertices == 4


@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply", ".stl", ".ply.gz"])
def test_a_pose_that_could_not_be_read_is_not_written(tmp_path, odd, suffix):
    path = tmp_path / f"m{suffix}"
    jd.save_mesh(path, odd)
    before = path.read_bytes()
    for pose, message in (
        (0 * odd.vertices, "load_mesh would refuse it .face 0 .* has no area"),
        (odd.vertices * [1, 0, 0], "load_mesh would refuse it .face 0 .* has no area"),
        (odd.vertices * 1e150, "load_mesh would refuse it .vertex .* leave the range of float64"),
        (odd.vertices * 1e-150, "load_mesh would refuse it .the mesh is .* leave the range"),
    ):
        with pytest.raises(jd.InputError, match=rf"m{suffix}: not written, because {message}"):
            jd.save_mesh(path, odd, vertices=pose)
    assert path.read_bytes() == before
    assert len(os.listdir(tmp_path)) == 1
