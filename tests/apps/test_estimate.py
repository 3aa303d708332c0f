"""The command that estimates rigidity."""

import json

import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._apps import estimating
from jaxdeform._apps.arguments import parts_by_place
from jaxdeform._mesh import files as mesh_files


@pytest.mark.slow
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
    picture = tmp_path / "shapes.png"
    options = ["--hold-out", 1, "-o", tmp_path / "out.ply", "--picture", picture]
    code, shown, _ = run("estimate", *names, *options)
    assert code == 0
    assert shown.index(f"wrote {picture}") < shown.index("evaluation 1:")
    assert shown.count(f"wrote {picture}") == 2
    (line,) = [line for line in shown.splitlines() if "twist.ply" in line]
    ours, arap = (float(word) for word in line.replace("\u2502", " ").split()[1:3])
    assert ours < 0.01 < arap
    code, _, told = run("estimate", *names, "--hold-out", 2, "-o", tmp_path / "o.ply")
    assert code == 2
    assert "--hold-out 2 leaves none of the 2 poses" in told


@pytest.mark.slow
def test_command_estimates_the_size_of_the_cells(run, tmp_path, bar, bar_problem):
    """With wide cells, which it finds, it predicts the twist of a bar of wide cells."""
    handles = bar_problem.handles
    points = bar.vertices[handles]
    wide = jd.precompute(bar, handles, cells=jd.rings(bar, 2))
    names = [tmp_path / f"{name}.ply" for name in ("rest", "bend", "twist")]
    jd.save_mesh(names[0], bar)
    for name, targets in zip(
        names[1:], (jd.bend(points, 60.0), jd.twist(points, 60.0)), strict=True
    ):
        jd.save_mesh(name, bar, vertices=jd.deform(wide, targets, 3.0).vertices)
    words = "estimate", *names, "--hold-out", 1, "-o", tmp_path / "out.ply", "--most-rings", 2
    code, shown, _ = run(*words)
    assert code == 0
    assert "rings 1: misfit" in shown
    assert "rings of the parts: 2" in shown
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["rings"] == [2]
    assert report["parts"][0]["rigidity"] == pytest.approx(3.0, rel=1e-3)
    (line,) = [line for line in shown.splitlines() if "twist.ply" in line]
    assert float(line.replace("\u2502", " ").split()[1]) < 0.01
    code, _, told = run(*words, "--steps", 100)
    assert code == 2
    assert "--most-rings goes with neither --rings nor --steps" in told


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
        ([rest, rest, "-o", out, "--picture", tmp_path / "p.jpg"], "p.jpg"),
        (
            [rest, rest, "-o", out, "--handles", rest, "--tolerance", 1e-3],
            "--tolerance is for handles that are to be found",
        ),
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


def test_bad_files_of_parts(run, files, bar):
    texts = {
        "parts have shape (3,): give one integer per vertex, (722,)": "0 1 0",
        "the part of vertex 0 is '1_0': give an integer": "1_0 " * 722,
        "the part of vertex 1 is 1000000000, out of range": "0 1000000000 " * 361,
        "the part of vertex 0 is '-0.5'": "-0.5 " * 722,
        "the part of vertex 2 is -1": "0 0 -1 " + "0 " * 719,
        "the part of vertex 0 is '" + "9" * 50: "9" * 5000 + " 0" * 721,
        "no vertex belongs to part 0": "1 " * 722,
    }
    lists = {
        "the part of vertex 0 is 0.5": [0.5, 1.7] * 361,
        "the part of vertex 1 is True": [0, True] * 361,
        "the part of vertex 0 is [0]": [[0]] * 722,
        "give a list of one integer per vertex": {"0": 1},
        "is not valid JSON": None,
    }
    for suffix, cases in ((".txt", texts), (".json", lists)):
        for message, content in cases.items():
            path = files / f"parts{suffix}"
            text = content if suffix == ".txt" else json.dumps(content)
            path.write_text("[" * 100_000 if content is None else str(text))
            code, out, err = run(
                "estimate", files / "bar.off", files / "bar.off", "-o", files / "o.ply",
                "--parts", path,
            )  # fmt: skip
            assert (code, out) == (2, ""), message
            assert f"parts{suffix}: {message}" in err
            assert len(err) < 1100
    # A byte-order mark does no harm, and neither do very long numbers.
    path = files / "parts.json"
    path.write_text("[" + ",".join(["9" * 5000] * 722) + "]", encoding="utf-8-sig")
    code, _, err = run("estimate", files / "bar.off", files / "bar.off", "-o", files / "o.ply",
                       "--parts", path)  # fmt: skip
    assert code == 2
    assert "parts.json: is not valid JSON (Exceeds the limit" in err


def test_parts_by_expressions(run, files, bar):
    y = bar.vertices[:, 1]
    found = parts_by_place(["y > 50", "y > 100"], bar)
    np.testing.assert_array_equal(found, np.where(y > 100, 2, np.where(y > 50, 1, 0)))
    assert not parts_by_place([], bar).any()
    two = "--part", "y < 50", "--part"
    for message, words in {
        "--part: 'y > 200' holds for no vertex: x runs from": ("--part", "y > 200"),
        "--part: no vertex is left for part 0, what no --part names": (*two, "y >= 50"),
        "--part: no vertex is left for part 1, 'y < 50'": (*two, "y < 60"),
        "--part and --parts are two ways": ("--part", "y > 50", "--parts", files / "p.txt"),
    }.items():
        code, out, err = run(
            "estimate", files / "bar.off", files / "bar.off", "-o", files / "o.ply", *words
        )
        assert (code, out) == (2, "")
        assert err.startswith(f"jaxdeform: {message}")


@pytest.mark.slow
def test_estimate_by_expressions_and_by_files_is_the_same(run, files, bar):
    bent = "--handles", files / "bend.json", "--rigidity", files / "rigidity.ply"
    pose, label = files / "pose.ply", (bar.vertices[:, 1] > 75.5).astype(int)
    run("deform", files / "bar.off", *bent, "-o", pose)
    (files / "p.txt").write_text(" ".join(map(str, label)))
    found = []
    for words in (("--parts", files / "p.txt"), ("--part", "y > 75.5")):
        code, _, err = run("estimate", files / "bar.off", pose, "-o", files / "fit.ply", *words)
        assert (code, err) == (0, "")
        found.append(jd.load_rigidity(files / "fit.ply"))
    np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(found[0], np.where(label, 30.0, 0.01), rtol=0.05)


def test_an_estimate_is_told_though_it_cannot_be_written(run, files, bar, monkeypatch):
    """The disk is full, say, when the work is done: the report is printed, and the run failed."""
    fit = jd.Estimate(
        rigidity=np.array([0.5]), material=np.array([0.1]), interval=np.array([[0.4, 0.6]]),
        verdict=(jd.Verdict.determined,), displacement=np.ones((1, 2)),
        discrepancy=jd.Discrepancy(False, 0.0, 0.0, 0.0, 0.0, 0, 0), field=np.full(722, 0.5),
        vertices=bar.vertices[None], misfit=0.0, diagonal=1.0, solver_error=0.0,
        outliers=np.zeros((1, 722), bool), history=np.zeros(2), result=jd.Result.converged,
    )  # fmt: skip
    monkeypatch.setattr(estimating, "_fit", lambda problem, *_: (problem, fit, None))
    writable = [False]

    def write(path, content):
        if not writable[0]:
            raise jd.InputError(f"{path}: cannot write there (No space left on device): make room")
        path.write_bytes(content)

    for module in (estimating, mesh_files):
        monkeypatch.setattr(module, "write_atomically", write)
    words = "estimate", files / "bar.off", files / "bar.off", "-o", files / "f.ply"
    code, out, err = run(*words)
    assert code == 2
    assert err == (
        f"jaxdeform: {files}/f.ply: cannot write there (No space left on device): make room\n"
    )
    start = out.index("\n{\n") + 1
    report, end = json.JSONDecoder().raw_decode(out[start:])
    assert len(report["parts"]) == 1
    assert report["found"] == {"tolerance": 1e-6, "doubt": ""}
    assert "estimated in" in out[start + end :]
    assert "wrote" not in out
    # Where only the name cannot be written, the field is beside it.
    writable[0] = True
    real = jd.save_mesh

    def save(path, *given, **named):
        if path.name == "f.ply":
            raise jd.InputError(f"{path}: is read-only: make it writeable")
        real(path, *given, **named)

    monkeypatch.setattr(jd, "save_mesh", save)
    code, out, err = run(*words)
    assert code == 2
    assert err.endswith(
        f"f.ply: is read-only: make it writeable; the result is in {files}/f.rescued.ply\n"
    )
    assert "estimated in" in out
    assert json.loads((files / "f.json").read_text())["parts"] == report["parts"]
    field = jd.load_rigidity(files / "f.rescued.ply")
    np.testing.assert_array_equal(field, np.full(722, report["parts"][0]["rigidity"]))
