"""The command that estimates rigidity."""

import json

import numpy as np
import pytest

import jaxdeform as jd


def test_command_estimates_parts_and_writes_them(run, tmp_path, bar, pose_of, halves):
    rest, pose, out = (tmp_path / name for name in ("rest.ply", "pose.ply", "out.ply"))
    jd.save_mesh(rest, bar)
    jd.save_mesh(pose, bar, vertices=pose_of(np.array([0.5, 30.0])[halves]))
    (tmp_path / "parts.txt").write_text("\n".join(map(str, halves)))
    options = ["--parts", tmp_path / "parts.txt", "--steps", 100, "-o", out]
    code, shown, _ = run("estimate", rest, pose, *options)
    assert code == 0
    np.testing.assert_allclose(jd.load_rigidity(out), np.array([0.5, 30.0])[halves], rtol=1e-6)
    report = json.loads((tmp_path / "out.json").read_text())
    assert [round(part["rigidity"], 4) for part in report["parts"]] == [0.5, 30.0]
    assert report["result"]["ok"]
    assert "2 groups of vertices moved rigidly (73, 73)" in shown
    assert "evaluation 1:" in shown


@pytest.mark.slow
def test_command_predicts_a_pose_that_was_held_out(run, tmp_path, bar, bar_problem):
    """A soft bar, fitted on a bend: its twist is predicted, and ARAP's is another."""
    names = [tmp_path / f"{name}.ply" for name in ("rest", "bend", "twist")]
    points = bar.vertices[bar_problem.handles]
    jd.save_mesh(names[0], bar)
    for name, targets in zip(
        names[1:], (jd.bend(points, 60.0), jd.twist(points, 60.0)), strict=True
    ):
        pose = jd.deform(bar_problem, targets, 0.3).vertices
        jd.save_mesh(name, bar, vertices=pose)
    options = ["--hold-out", 1, "-o", tmp_path / "out.ply"]
    code, shown, _ = run("estimate", *names, *options)
    assert code == 0
    (line,) = [line for line in shown.splitlines() if "twist.ply" in line]
    ours, arap = (float(word) for word in line.replace("\u2502", " ").split()[1:3])
    assert ours < 0.01 < arap
    code, _, told = run("estimate", *names, "--hold-out", 2, "-o", tmp_path / "o.ply")
    assert code == 2
    assert "--hold-out 2 leaves none of the 2 poses" in told


def test_command_refuses_what_does_not_fit(run, tmp_path, bar):
    rest, other, out = (tmp_path / name for name in ("rest.ply", "other.ply", "out.ply"))
    jd.save_mesh(rest, bar)
    jd.save_mesh(other, jd.Mesh(bar.vertices, bar.faces[::-1]))
    (tmp_path / "short.txt").write_text("0 1 0")
    for name, text in {
        "words.json": '["soft"]',
        "halves.json": "[0.5, 1.7" + ", 0" * 720 + "]",
        "huge.json": "[1000000000" + ", 0" * 721 + "]",
        "deep.json": "[" * 100_000,
        "keys.json": '{"0": 1}',
        "marks.txt": "1_0" + " 0" * 721,
    }.items():
        (tmp_path / name).write_text(text)
    out.write_text("kept")
    for arguments, message in (
        ([rest, other, "-o", out], "other.ply: is not a pose of"),
        ([rest, rest, "-o", tmp_path / "out.obj"], "only PLY"),
        ([rest, rest, "-o", out, "--parts", tmp_path / "short.txt"], "parts have shape"),
        (
            [rest, rest, "-o", out, "--parts", tmp_path / "words.json"],
            "words.json: the part of vertex 0 is 'soft'",
        ),
        ([rest, tmp_path / "none.ply", "-o", out], "none.ply"),
    ):
        code, _, told = run("estimate", *arguments)
        assert code == 2
        assert message in told
        assert told.count("\n") == 1
    assert out.read_text() == "kept"
