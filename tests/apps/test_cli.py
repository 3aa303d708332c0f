"""The command line."""

import dataclasses
import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import lower_and_upper
from PIL import Image

import jaxdeform as jd
from jaxdeform._apps.arguments import read_pose
from jaxdeform._mesh.files import without_suffix


def drawn(path):
    """Return the pixels that are not background, as a share, and the number of their colours."""
    pixels = np.asarray(Image.open(path).convert("RGB"))
    ink = (pixels != pixels[0, -1]).any(axis=2)
    return ink.mean(), len(np.unique(pixels[ink], axis=0))


def test_demo(run, tmp_path, bar):
    code, out, err = run("demo", "--out", tmp_path / "new" / "folder")
    assert (code, err) == (0, "")
    folder = tmp_path / "new" / "folder"
    names = {"soft", "stiff", "soft-below-stiff"}
    assert {path.name for path in folder.iterdir()} == {f"{n}.ply" for n in names} | {"demo.png"}
    assert all(name in out for name in names)
    share, colours = drawn(folder / "demo.png")
    assert 0.02 < share < 0.9
    assert colours > 100
    _, high = lower_and_upper(bar)
    poses = []
    for name in names:
        mesh = jd.load_mesh(folder / f"{name}.ply")
        turned = np.stack([bar.vertices[high, 1] - 75.5, 75.5 - bar.vertices[high, 0]], axis=1)
        np.testing.assert_allclose(mesh.vertices[high, :2], turned, atol=1e-9)
        poses.append(mesh.vertices)
    for k in range(3):
        assert np.abs(poses[k] - poses[k - 1]).max() > 1.0  # of a bar 151 long
    rigidity = jd.load_rigidity(folder / "soft-below-stiff.ply")
    assert sorted(set(rigidity)) == [0.01, 30.0]
    assert rigidity[bar.vertices[:, 1] < 60].max() == 0.01


def test_deform_by_json_with_all_settings(run, files, bar):
    code, out, err = run(
        "deform", files / "bar.off", "--handles", files / "bend.json", "--rigidity", 2.5,
        "--rings", 2, "--steps", 7, "--normals", "-o", files / "out.ply",
        "--picture", files / "out.png",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "after 7 steps" in out
    assert str(files / "out.ply") in out
    handles = np.concatenate(lower_and_upper(bar))
    problem = jd.precompute(bar, handles, cells=jd.rings(bar, 2))
    targets = jd.bend(bar.vertices[handles], 90.0)
    want = jd.deform(problem, targets, 2.5, solver=jd.Alternating(7), normals=True)
    np.testing.assert_allclose(jd.load_mesh(files / "out.ply").vertices, want.vertices, atol=1e-8)
    np.testing.assert_array_equal(jd.load_rigidity(files / "out.ply"), np.full(722, 2.5))
    share, colours = drawn(files / "out.png")
    assert share > 0.02
    assert colours > 10


def test_deform_by_survey_files_with_a_rigidity_per_vertex(run, files, bar):
    """Written over the mesh it was read from, which is safe."""
    code, out, err = run(
        "deform", files / "bar.off", "--handles", files / "bend.sel", "--rigidity",
        files / "rigidity.ply", "-o", files / "bar.off", "--motion", files / "bend.def",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert "Converged" in out
    handles = np.sort(np.concatenate(lower_and_upper(bar)))
    values = jd.load_rigidity(files / "rigidity.ply")
    want = jd.deform(jd.precompute(bar, handles), jd.bend(bar.vertices[handles], 90.0), values)
    # Two starts of the same iteration, whose targets differ by rounding.
    np.testing.assert_allclose(jd.load_mesh(files / "bar.off").vertices, want.vertices, atol=1e-4)


def test_inspect(run, files):
    code, out, err = run("inspect", files / "bar.off")
    assert (code, err) == (0, "")
    assert "vertices               722" in out
    assert "nothing unusual" in out
    (files / "flat.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n")
    code, out, _ = run("inspect", files / "flat.off")
    assert code == 0
    assert (
        "1 face has no area (face 0): edges weigh nothing there; jd.repair drops such faces" in out
    )
    code, out, err = run("inspect", files / "none[b].off")
    assert (code, out) == (2, "")
    assert err == f"jaxdeform: {files}/none[b].off: cannot be read " + (
        "(No such file or directory): check the name\n"
    )


MISTAKES = {
    "is neither a number nor": {"--rigidity": "soft"},
    "--rigidity 1_0: is neither a number nor a file": {"--rigidity": "1_0"},
    "--rigidity nan: rigidity is nan: it must be": {"--rigidity": "nan"},
    "--rigidity -1: rigidity is -1.0": {"--rigidity": "-1"},
    "inf": {"--rigidity": "inf"},
    "--rigidity aaaa": {"--rigidity": 300 * "a"},
    "short.ply: rigidity has shape (9,): give one number": {"--rigidity": "{}/short.ply"},
    "plain.ply: its vertices have no property 'rigidity'": {"--rigidity": "{}/plain.ply"},
    "bar.off: rigidity is kept in .ply files only": {"--rigidity": "{}/bar.off"},
    "none.off: cannot be read": {"mesh": "{}/none.off"},
    "bend.json: unknown suffix '.json'": {"mesh": "{}/bend.json"},
    "none.json: cannot be read": {"--handles": "{}/none.json"},
    "handle files end in .json or .sel": {"--handles": "{}/bar.off"},
    "none.def: cannot be read": {"--handles": "{}/bend.sel", "--motion": "{}/none.def"},
    "out.xyz: unknown suffix '.xyz'": {"-o": "{}/out.xyz"},
    "cannot write there: make the folder": {"-o": "{}/none/out.ply"},
    "is a folder: give the name of a file": {"-o": "{}/folder.ply"},
    "out.jpg: pictures are PNG files": {"--picture": "{}/out.jpg"},
    "out.png: cannot write there: make the folder": {"--picture": "{}/none/out.png"},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_is_one_line_before_any_work(run, files, monkeypatch, message):
    given = {
        "mesh": "{}/bar.off", "--handles": "{}/bend.json", "--rigidity": "1", "-o": "{}/out.ply",
        **MISTAKES[message],
    }  # fmt: skip
    monkeypatch.setattr(jd, "precompute", lambda *_, **__: pytest.fail("began to work"))
    (files / "folder.ply").mkdir()
    (files / "out.ply").write_text("old")
    before = sorted(os.listdir(files))
    mesh = given.pop("mesh").format(files)
    code, out, err = run("deform", mesh, *(w.format(files) for kv in given.items() for w in kv))
    assert (code, out) == (2, "")
    assert err.startswith("jaxdeform: ")
    assert err.count("\n") == 1
    assert message in err
    assert (files / "out.ply").read_text() == "old"
    assert sorted(os.listdir(files)) == before


def test_mistakes_found_while_precomputing(run, files):
    (files / "one.json").write_text('{"handles": [{"vertices": [0]}]}')
    two = jd.shapes.bar()
    v, f = two.vertices, np.asarray(two.faces)
    jd.save_mesh(
        files / "two.off", jd.Mesh(np.concatenate([v, v + 999]), np.concatenate([f, f + 722]))
    )
    code, _, err = run(
        "deform", files / "two.off", "--handles", files / "one.json", "--rigidity", 1,
        "-o", files / "out.off",
    )  # fmt: skip
    assert code == 2
    assert err.startswith("jaxdeform: the connected component with vertex 722")
    assert not (files / "out.off").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("bend",),
        ("inspect",),
        ("deform", "bar.off"),
        ("inspect", "bar.off", "--loud"),
        ("deform", "m.off", "--handles", "h", "--rigidity", "1", "-o", "o.off", "--steps", "0"),
        ("deform", "m.off", "--handles", "h", "--rigidity", "1", "-o", "o.off", "--rings", "x"),
    ],
)
def test_wrong_usage_ends_with_code_2(run, arguments):
    code, out, err = run(*arguments)
    assert code == 2
    assert "Usage" in out + err
    assert "Traceback" not in err


@pytest.mark.parametrize("command", ["demo", "inspect", "deform"])
def test_help(run, command):
    code, out, _ = run(command, "--help")
    assert code == 0
    assert "Usage" in out


def test_a_folder_that_cannot_be_made(run, files):
    code, _, err = run("demo", "-o", files / "bar.off" / "x")
    assert code == 2
    assert err.startswith(f"jaxdeform: {files}/bar.off/x: cannot be made")


def test_importing_the_command_line_does_not_turn_on_float64():
    code = "import jax, jaxdeform._apps.cli; print(jax.config.jax_enable_x64)"
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "False\n"


def test_commands_compute_in_float64(run, files, monkeypatch):
    seen = []
    monkeypatch.setattr(jd, "inspect", lambda _: seen.append(jax.config.jax_enable_x64))
    jax.config.update("jax_enable_x64", False)
    try:
        assert run("inspect", files / "bar.off")[0] == 0
    finally:
        jax.config.update("jax_enable_x64", True)
    assert seen == [True]


def test_ctrl_c_leaves_old_files_whole(files):
    (files / "out.ply").write_text("old")
    before = sorted(os.listdir(files))
    process = subprocess.Popen(
        [
            Path(sys.executable).parent / "jaxdeform", "deform", files / "bar.off", "--handles",
            files / "bend.json", "--rigidity", "1", "-o", files / "out.ply", "--steps", "1000000",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("fixed: ")
        assert "precomputed" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert err == "jaxdeform: interrupted; no file was left half-written\n"
    assert (files / "out.ply").read_text() == "old"
    assert sorted(os.listdir(files)) == before


def spoken_to(files, target, *arguments, errors=subprocess.PIPE):
    """Run the command with its output closed or on a full disk: exit code and errors.

    With ``errors=subprocess.STDOUT`` the errors go where the output goes.
    """
    command = [Path(sys.executable).parent / "jaxdeform", *arguments]
    if target == "closed":
        reader, writer = os.pipe()
        os.close(reader)
    else:
        writer = os.open("/dev/full", os.O_WRONLY)
    try:
        done = subprocess.run(command, stdout=writer, stderr=errors, text=True)
    finally:
        os.close(writer)
    return done.returncode, done.stderr


FULL = "jaxdeform: standard output cannot be written (No space left on device)\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has such a device")
@pytest.mark.parametrize(("target", "end"), [("closed", (0, "")), ("full", (1, FULL))])
def test_the_result_is_written_though_nobody_listens(files, target, end):
    out = files / "out.ply"
    found = spoken_to(
        files, target, "deform", files / "bar.off", "--handles", files / "bend.json",
        "--rigidity", "1", "-o", out, "--steps", "1",
    )  # fmt: skip
    assert found == end
    assert jd.load_mesh(out).n_vertices == 722
    assert spoken_to(files, target, "inspect", out) == end


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has such a device")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_text_of_help_that_cannot_be_written(files, monkeypatch, unbuffered):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    assert spoken_to(files, "full", "deform", "--help") == (1, FULL)


def test_a_failure_that_is_not_of_the_output_is_not_called_one(run, files, monkeypatch):
    def fail(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(jd, "inspect", fail)
    with pytest.raises(OSError, match="No space left on device"):
        run("inspect", files / "bar.off")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has such a device")
@pytest.mark.parametrize("target", ["closed", "full"])
def test_every_file_is_written_though_nobody_hears_the_warnings(files, target):
    """As in ``2>&1 | true``: each frame loses a material, and says so to nobody."""
    bar = files / "bar.obj"
    jd.save_mesh(bar, jd.load_mesh(files / "bar.off"))
    bar.write_text(bar.read_text().replace("\nf ", "\nusemtl wood\nf ", 1))
    code, _ = spoken_to(
        files, target, "deform", bar, "--handles", files / "bend.json",
        "-o", files / "out.ply", "--frames", "3", "--method", "laplacian",
        errors=subprocess.STDOUT,
    )  # fmt: skip
    assert code == (target == "full")
    for k in (1, 2, 3):
        assert jd.load_mesh(files / f"out_000{k}.ply").n_vertices == 722


def test_cells_that_are_inside_out_are_told(run, files, monkeypatch):
    plain = jd.deform

    def with_a_flipped_cell(*arguments, **settings):
        out = plain(*arguments, **settings)
        return dataclasses.replace(out, transforms=out.transforms.at[5, 0].multiply(-1.0))

    monkeypatch.setattr(jd, "deform", with_a_flipped_cell)
    code, out, _ = run(
        "deform", files / "bar.off", "--handles", files / "bend.json", "--rigidity", 1,
        "-o", files / "out.ply",
    )  # fmt: skip
    assert code == 0
    assert "Cells inside out (det T <= 0): 5 (1 of 722)." in out


@pytest.mark.skipif(os.name == "nt", reason="a shell closes them")
@pytest.mark.parametrize("shut", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_the_result_is_written_though_the_outputs_are_closed(files, shut):
    """Python has None for a standard output or error that the shell closed."""
    program = str(Path(sys.executable).parent / "jaxdeform")

    def said(*words):
        line = f"{shlex.join([program, *map(str, words)])} {shut}"
        return subprocess.run(["sh", "-c", line], capture_output=True, text=True)

    out = files / "out.ply"
    done = said(
        "deform", files / "bar.off", "--handles", files / "bend.json", "--rigidity", 1,
        "-o", out, "--steps", 1,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert ("wrote" in done.stdout) == (shut == "2>&-")
    assert jd.load_mesh(out).n_vertices == 722
    assert said("inspect", out).returncode == 0
    wrong = said("inspect", files / "none.off")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert wrong.stderr.count("\n") == (shut == ">&-")


def test_a_mesh_of_quads_comes_back_as_quads(run, files):
    """With what else the file held."""
    lines = [f"v {x} {y} {0.1 * x * y} 0.5 0.5 0.5" for x in range(4) for y in range(4)]
    lines += [f"f {k}/{k} {k + 4}/{k} {k + 5}/{k} {k + 1}/{k}" for k in range(1, 12) if k % 4]
    old = "\n".join(["mtllib a.mtl", "usemtl b", *[f"vt 0 {k}" for k in range(12)], *lines])
    (files / "grid.obj").write_text(old)
    ends_ = {"vertices": [0, 1, 2, 3]}, {"vertices": [12, 13, 14, 15], "translation": [0, 0, 2]}
    (files / "lift.json").write_text(json.dumps({"handles": ends_}))
    code, _, err = run(
        "deform", files / "grid.obj", "--handles", files / "lift.json", "--rigidity", 1,
        "-o", files / "out.obj",
    )  # fmt: skip
    assert (code, err) == (0, "")
    new = (files / "out.obj").read_text()
    others = lambda text: [line for line in text.split("\n") if line[:2] != "v "]  # noqa: E731
    assert others(new) == others(old)
    assert new.count(" 0.5 0.5 0.5") == 16


def test_a_pose_may_be_cut_along_other_diagonals(tmp_path):
    quad = "OFF\n4 1 0\n0 0 0\n{} 0 0\n1 {} 0\n0 1 0\n4 0 1 2 3\n"
    for name, x, y in (("rest", 1, 1.5), ("pose", 1.5, 1)):
        (tmp_path / f"{name}.off").write_text(quad.format(x, y))
    rest, pose = (jd.load_mesh(tmp_path / f"{name}.off") for name in ("rest", "pose"))
    assert rest.faces.tolist() != pose.faces.tolist()
    found = read_pose(tmp_path / "pose.off", rest, tmp_path / "rest.off")
    np.testing.assert_array_equal(found, pose.vertices)
    jd.save_mesh(tmp_path / "turned.off", jd.Mesh(rest.vertices, rest.faces[:, ::-1]))
    with pytest.raises(jd.InputError, match=r"turned\.off: is not a pose of"):
        read_pose(tmp_path / "turned.off", rest, tmp_path / "rest.off")


def test_the_report_beside_a_compressed_file(tmp_path):
    for name in ("fit.ply", "fit.ply.gz", "fit.PLY.GZ"):
        assert without_suffix(tmp_path / name) == tmp_path / "fit"


def test_what_stl_cannot_hold_is_refused_before_the_work_and_rescued_after(run, files, bar):
    far = jd.Mesh(bar.vertices + 1e9, bar.faces)
    jd.save_mesh(files / "far.off", far)
    arguments = "--handles", files / "bend.json", "--rigidity", 1, "--steps", 1
    code, out, err = run("deform", files / "far.off", *arguments, "-o", files / "far.stl")
    assert (code, out) == (2, "")
    assert "far.stl: not written: STL keeps single precision" in err
    # Here only the pose is far away.
    y = bar.vertices[:, 1]
    low = [int(k) for k in np.flatnonzero(y < 6)]
    groups = [{"vertices": low, "translation": [1e9, 0, 0]}]
    (files / "away.json").write_text(json.dumps({"handles": groups}))
    code, out, err = run(
        "deform", files / "bar.off", "--handles", files / "away.json", "--rigidity", 1,
        "--steps", 1, "-o", files / "bent.stl",
    )  # fmt: skip
    assert code == 2
    assert "bent.stl: not written: STL keeps single" in err
    assert err.endswith(f"; the result is in {files}/bent.rescued.ply\n")
    assert jd.load_mesh(files / "bent.rescued.ply").n_vertices == 722


def test_the_package_runs_as_a_module(tmp_path, bar):
    jd.save_mesh(tmp_path / "bar.off", bar)
    command = [sys.executable, "-m", "jaxdeform", "inspect"]
    done = subprocess.run(
        [*command, tmp_path / "bar.off"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("vertices")
    assert "722" in done.stdout.splitlines()[0]
    failed = subprocess.run([*command, "none.off"], capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert failed.stderr.startswith("jaxdeform: none.off: cannot be read")
