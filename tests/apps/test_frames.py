"""The command deform along a path: a numbered series, and an animated picture."""

import json

import numpy as np
import pytest
from helpers import EXACT
from PIL import Image, ImageSequence

import jaxdeform as jd


@pytest.fixture
def deform(run, monkeypatch, tmp_path):
    """Return a function that runs ``deform`` on a bar 1 high: (exit code, stdout, stderr)."""
    bar = jd.shapes.bar()
    jd.save_mesh(tmp_path / "bar.obj", jd.Mesh(bar.vertices / 151, bar.faces))
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run("deform", "bar.obj", *arguments)


WHERE = "--fix", "y<0.1", "--move", "y>0.9"
TURN = range(10, 361, 10)
MOTION = "--rotate", "y", 300, "--translate", 0.1, 0.2, 0


def moved_by(share):
    """Return the mesh, its handles, and where they are after a share of the motion."""
    mesh = jd.load_mesh("bar.obj")
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 0.1) | (y > 0.9))
    targets, up = mesh.vertices[handles], y[handles] > 0.9
    angle = share * np.radians(300)
    c, s = np.cos(angle), np.sin(angle)
    center = targets[up].mean(axis=0)
    turned = (targets[up] - center) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + center
    targets[up] = turned + share * np.array([0.1, 0.2, 0])
    return mesh, handles, targets


@pytest.mark.slow
def test_a_series_of_even_steps(deform, tmp_path):
    (tmp_path / "out_0002.ply").write_text("old")
    (tmp_path / "out_0004.ply").write_text("of a longer series")
    code, out, err = deform(
        *WHERE, *MOTION, "--rigidity", 10, "--frames", 3, "-o", "out.ply", "--picture", "out.gif"
    )
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "fixed: 97 vertices, moved: 97 vertices"
    assert lines[2].startswith("energy ")
    assert "in the last frame" in lines[2]
    assert lines[3].startswith("3 of 3 frames: Converged")
    assert "wrote out_0001.ply to out_0003.ply" in lines
    assert any(line.startswith("out_0004.ply was there before") for line in lines)
    assert lines[-1] == "wrote out.gif"
    assert (tmp_path / "out_0004.ply").read_text() == "of a longer series"
    mesh, handles, _ = moved_by(0.0)
    targets = np.stack([moved_by(share)[2] for share in (1 / 3, 2 / 3, 1.0)])
    problem = jd.precompute(mesh, handles)
    want = jd.deform_path(problem, targets, 10.0, progress=lambda *_: None)
    for k in range(3):
        found = jd.load_mesh(f"out_{k + 1:04d}.ply").vertices
        np.testing.assert_allclose(found[handles], targets[k], atol=EXACT)
        np.testing.assert_allclose(found, want.vertices[k], atol=1e-4)  # of the tolerance
        np.testing.assert_array_equal(jd.load_rigidity(f"out_{k + 1:04d}.ply"), np.full(722, 10.0))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"bar.obj", "out.gif", *(f"out_000{k}.ply" for k in range(1, 5))}
    with Image.open("out.gif") as film:
        shown = [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(film)]
    assert len(shown) == 3
    assert all((np.abs(shown[k] - shown[k - 1]).max(axis=2) > 8).mean() > 1e-3 for k in range(3))


def test_editing_follows_too_and_names_keep_both_suffixes(deform):
    code, out, err = deform(
        *WHERE, *MOTION, "--method", "laplacian", "--frames", 2, "-o", "a.b.obj.gz"
    )
    assert (code, err) == (0, "")
    assert "wrote a.b_0001.obj.gz to a.b_0002.obj.gz" in out
    for k, share in ((1, 0.5), (2, 1.0)):
        mesh, handles, targets = moved_by(share)
        want = jd.laplacian_editing(mesh, handles, targets)
        found = jd.load_mesh(f"a.b_000{k}.obj.gz").vertices
        np.testing.assert_allclose(found, want, atol=1e-8)


def test_frames_of_smooth_rotations_start_from_the_frame_before(deform):
    code, out, err = deform(
        *WHERE, *MOTION, "--method", "sr-arap", "--steps", 7, "--frames", 3, "-o", "out.obj"
    )
    assert (code, err) == (0, "")
    assert "in the last frame, after 21 steps" in out
    last = None
    for k in range(1, 4):
        mesh, handles, targets = moved_by(k / 3)
        last = jd.sr_arap(mesh, handles, targets, start=last, steps=7).vertices
        np.testing.assert_allclose(jd.load_mesh(f"out_000{k}.obj").vertices, last, atol=1e-8)


def test_targets_of_a_file_are_reached_on_straight_lines(deform, tmp_path):
    turn = {"axis": [0, 1, 0], "degrees": 170}
    groups = [{"where": "y < 0.1"}, {"where": "y > 0.9", "rotation": turn}]
    (tmp_path / "h.json").write_text(json.dumps({"handles": groups}))
    code, _, err = deform(
        "--handles", "h.json", "--method", "laplacian", "--frames", 4, "-o", "out.obj"
    )
    assert (code, err) == (0, "")
    mesh = jd.load_mesh("bar.obj")
    handles, targets = jd.load_handles("h.json", mesh)
    rest = mesh.vertices[handles]
    for k in range(1, 5):
        found = jd.load_mesh(f"out_000{k}.obj").vertices[handles]
        np.testing.assert_allclose(found, rest + k / 4 * (targets - rest), atol=EXACT)


MISTAKES = {
    "out.gif: a GIF shows the frames of a path: give --frames N": ["--picture", "out.gif"],
    "out.jpg: pictures are PNG files": ["--frames", 2, "--picture", "out.jpg"],
    "out: unknown suffix '': use one of .obj": ["--frames", 2, "-o", "out"],
    "out_0003.obj: is a folder: give the name of a file": ["--frames", 3],
    "none/out_0001.obj: cannot write there: make the folder": ["--frames", 2, "-o", "none/out.obj"],
}


@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_is_told_before_any_work(deform, monkeypatch, tmp_path, message):
    (tmp_path / "out_0003.obj").mkdir()
    monkeypatch.setattr(jd, "precompute", lambda *_, **__: pytest.fail("began to work"))
    arguments = MISTAKES[message]
    named = [] if "-o" in arguments else ["-o", "out.obj"]
    code, out, err = deform(*WHERE, *MOTION, *named, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith(f"jaxdeform: {message}")
    assert err.count("\n") == 1


@pytest.mark.parametrize("frames", [0, 10000, "many"])
def test_a_wrong_number_of_frames_names_the_option(deform, frames):
    code, out, err = deform(*WHERE, *MOTION, "-o", "out.obj", "--frames", frames)
    assert (code, out) == (2, "")
    assert "'--frames'" in err
    assert "Traceback" not in err


def test_what_one_frame_cannot_hold_keeps_no_other_from_being_written(deform, tmp_path):
    """The last frames are too far away for a binary STL."""
    away = *WHERE, "--translate", 3e7, 0, 0, "--method", "laplacian", "--frames", 2
    code, _, err = deform(*away, "-o", "out.stl")
    assert code == 2
    assert "out_0001.stl: not written: STL keeps single precision" in err
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"bar.obj", "out_0001.rescued.ply", "out_0002.rescued.ply"}


@pytest.mark.slow
def test_frames_that_stop_early_or_turn_inside_out_are_counted(deform, monkeypatch):
    hasty = jd.QuasiNewton(max_steps=3, metric="stiffness")
    path = jd.deform_path
    monkeypatch.setattr(jd, "deform_path", lambda *a, **k: path(*a, **{**k, "solver": hasty}))
    code, out, _ = deform(*WHERE, *MOTION, "--rigidity", 1e-9, "--frames", 7, "-o", "out.obj")
    assert code == 0
    assert "7 of 7 frames (1, 2, 3, 4, 5, ...): Stopped at the step limit" in out
    assert "frames (" in out.split("Stopped")[1]
    assert "have cells inside out" in out


@pytest.mark.slow
def test_a_jump_is_told_with_its_energies(deform):
    motion = "--rotate", "y", 360, "--frames", 36, "--rigidity", 1e-3
    code, out, err = deform(*WHERE, *motion, "-o", "out.obj")
    assert (code, err) == (0, "")
    told = [line for line in out.splitlines() if "the shape jumped" in line]
    assert told
    mesh, handles, _ = moved_by(0.0)
    points = mesh.vertices[handles]
    up = points[:, 1] > 0.9
    targets = np.stack(
        [np.where(up[:, None], jd.rotate(points, a, axis="y"), points) for a in TURN]
    )
    want = jd.deform_path(jd.precompute(mesh, handles), targets, 1e-3)
    first = int(np.argmax(want.jumped))
    before, after = (f"{float(want.energy[k, -1]):.4g}" for k in (first - 1, first))
    assert told[0].startswith(f"frame {first + 1}: the shape jumped to another equilibrium")
    assert f"(energy {before} to {after})" in told[0]
    assert len(told) == int(np.sum(want.jumped))
