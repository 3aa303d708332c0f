"""Handle files: targets against scipy's matrix exponential, and every way to write one wrongly."""

import json
import tracemalloc

import numpy as np
import pytest
from helpers import EXACT, REAL, real_mesh
from scipy.linalg import expm

import jaxdeform as jd


def write(tmp_path, *groups):
    path = tmp_path / "handles.json"
    path.write_text(json.dumps({"handles": groups}))
    return path


def turned(points, axis, degrees, center):
    x, y, z = np.array(axis) / np.linalg.norm(axis) * np.radians(degrees)
    matrix = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    return (points - center) @ matrix.T + center


def test_json_groups_move_as_they_say(tmp_path, bar):
    groups = [
        {"vertices": [5, 3], "name": "stays"},
        {"vertices": [700, 10, 12], "translation": [1, -2, 0.5]},
        {"vertices": [20, 30, 40], "rotation": {"axis": [0, 0, 2], "degrees": 90}},
        {
            "vertices": [50, 60],
            "rotation": {"axis": [1, -1, 3], "degrees": -400, "center": [1, 2, 3]},
            "translation": [0, 10, 0],
        },
        {"vertices": [70, 71], "targets": [[1, 2, 3], [4, 5, 6.5]]},
    ]
    handles, targets = jd.load_handles(write(tmp_path, *groups), bar)
    assert handles.tolist() == [5, 3, 700, 10, 12, 20, 30, 40, 50, 60, 70, 71]
    v = bar.vertices
    turn = v[[20, 30, 40]]
    want = [
        v[[5, 3]],
        v[[700, 10, 12]] + [1, -2, 0.5],
        turned(turn, [0, 0, 1], 90, turn.mean(axis=0)),
        turned(v[[50, 60]], [1, -1, 3], -400, np.array([1, 2, 3])) + np.array([0, 10, 0]),
        [[1, 2, 3], [4, 5, 6.5]],
    ]
    np.testing.assert_allclose(targets, np.concatenate(want), atol=EXACT)


def test_groups_by_expressions_are_those_by_their_indices(tmp_path, bar):
    y = bar.vertices[:, 1]
    motion = {"rotation": {"axis": [0, 0, 1], "degrees": 30}, "translation": [0, 5, 0]}
    low, high = np.flatnonzero(y < 6), np.flatnonzero(y > 145)
    by_index = [{"vertices": low.tolist()}, {"vertices": high.tolist(), **motion}]
    want = jd.load_handles(write(tmp_path, *by_index), bar)
    by_place = [{"where": "y < 6", "name": "foot"}, {"where": "y > 145", **motion}]
    by_mask = [{"vertices": (y < 6).tolist()}, {"where": "v > 145 / 151", **motion}]
    for groups in (by_place, by_mask):
        found = jd.load_handles(write(tmp_path, *groups), bar)
        np.testing.assert_array_equal(found.handles, want.handles)
        np.testing.assert_array_equal(found.targets, want.targets)


@pytest.mark.parametrize("axis", [[1e308, 1e308, 0], [1e200, 1e200, 0], [1e-200, 1e-200, 0], "x"])
def test_an_axis_may_have_any_length_or_be_a_name(tmp_path, bar, axis):
    rotation = {"axis": axis, "degrees": 50, "center": [1, 2, 3]}
    found = jd.load_handles(write(tmp_path, {"vertices": [3, 700], "rotation": rotation}), bar)
    plain = [1, 0, 0] if axis == "x" else [1, 1, 0]
    want = turned(bar.vertices[[3, 700]], plain, 50, np.array([1, 2, 3]))
    np.testing.assert_allclose(found.targets, want, atol=EXACT)
    assert found.targets.dtype == np.float64


def test_a_wrong_expression_in_a_file_has_its_caret(tmp_path, bar):
    with pytest.raises(jd.InputError) as caught:
        jd.load_handles(write(tmp_path, {"where": "y < 6 &"}), bar)
    assert caught.value.__notes__ == ["    y < 6 &\n          ^"]


GOOD = {"vertices": [0, 1]}
BAD_GROUPS = {
    'group 0: give either "vertices", a list of indices, or "where"': [{"vertex": [0]}],
    'group 1: give either "vertices"': [GOOD, [3, 4]],
    'group 2: give either "vertices"': [GOOD, {"where": "y < 6"}, {**GOOD, "where": "y < 6"}],
    "group 0: where is a list: give a text such as 'y > 0.9": [{"where": [0, 1]}],
    "group 0: where: found '=' .write ==. instead of .* at column 3 of 'y = 6'": [
        {"where": "y = 6"}
    ],
    "group 0: where: 'y > 200' holds for no vertex: .*y from 0 to 151": [{"where": "y > 200"}],
    "handles.json: vertex 0 is a handle 2 times": [GOOD, {"where": "x == x"}],
    r"group 0: handles: the mask has shape \(2,\): give \(722,\)": [{"vertices": [True, False]}],
    "group 0: no handles": [{"vertices": []}],
    "group 0: handles have shape": [{"vertices": 3}],
    "group 0: handles must be integers, got float64": [{"vertices": [0.5]}],
    "group 0: handle 722 .position 1. is out of range": [{"vertices": [0, 722]}],
    "group 0: handle -1 ": [{"vertices": [-1]}],
    "group 0: vertex 3 is a handle 2 times": [{"vertices": [3, 3]}],
    "handles.json: vertex 1 is a handle 2 times": [GOOD, {"vertices": [1, 2]}],
    "group 1 has the unknown key 'traslation': use vertices": [
        GOOD,
        {"vertices": [5], "traslation": [0, 0, 1]},
    ],
    "group 0: translation: give 3 finite numbers": [{**GOOD, "translation": [0, 1]}],
    "group 0: translation cannot be read as numbers: it is text": [
        {**GOOD, "translation": ["a", 1, 2]}
    ],
    "group 0: translation cannot be read as numbers: it holds booleans among numbers": [
        {**GOOD, "translation": [True, 0, 0]}
    ],
    "group 0: translation: true and false are no numbers: give numbers": [
        {**GOOD, "translation": [True, False, False]}
    ],
    "group 0: translation: the moved points overflow: give a smaller motion": [
        {
            "vertices": [0, 1],
            "rotation": {"axis": [0, 0, 1], "degrees": 180, "center": [0.8e308, 0, 0]},
            "translation": [1.7e308, 0, 0],
        }
    ],
    "group 0: rotation: the moved points overflow": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": 180, "center": [1.7e308, 0, 0]}}
    ],
    "group 0: handles cannot be read as numbers: it holds booleans among numbers": [
        {"vertices": [True, 0]}
    ],
    "group 0: targets: give 2 x 3 finite": [{**GOOD, "targets": [[0, 1, 2]]}],
    "group 0: targets: give 2 x 3 finite numbers": [
        {**GOOD, "targets": [[0, 1, float("nan")], [0, 0, 0]]}
    ],
    "group 0 has targets and a motion": [
        {**GOOD, "targets": [[0, 0, 0], [1, 1, 1]], "translation": [0, 0, 1]}
    ],
    'group 0: rotation needs "axis" and "degrees"': [{**GOOD, "rotation": {"axis": [0, 0, 1]}}],
    "group 0: rotation: axis is .0. 0. 0..: give 'x', 'y', 'z' or a vector .3,. that is not": [
        {**GOOD, "rotation": {"axis": [0, 0, 0], "degrees": 9}}
    ],
    "group 0: rotation: axis is 'w': give 'x', 'y', 'z' or": [
        {**GOOD, "rotation": {"axis": "w", "degrees": 9}}
    ],
    "group 0: axis cannot be read as numbers: it holds booleans": [
        {**GOOD, "rotation": {"axis": [0, 0, True], "degrees": 9}}
    ],
    "group 0: degrees: true and false are no numbers": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": True}}
    ],
    "group 0: rotation: degrees is 1e.12, of which rounding leaves no angle: give at most": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": 1e12}}
    ],
    "group 0: rotation: degrees is -1e.300, of which rounding": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": -1e300}}
    ],
    "group 0: degrees: give one finite number": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": [1, 2]}}
    ],
    "group 0: center: give 3 finite numbers": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": 1, "center": 5}}
    ],
    "group 0: rotation has the unknown key 'centre': use axis": [
        {**GOOD, "rotation": {"axis": [0, 0, 1], "degrees": 1, "centre": [0, 0, 0]}}
    ],
}


@pytest.mark.parametrize("message", BAD_GROUPS)
def test_bad_groups_are_named(tmp_path, bar, message):
    path = write(tmp_path, *BAD_GROUPS[message])
    with pytest.raises(jd.InputError, match=message) as error:
        jd.load_handles(path, bar)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"x", "is not valid JSON .*line 1 column 1"),
        (b'{"handles": [{"vertices": [0, 1]}', "is not valid JSON"),
        (b"[" * 100_000, "is not valid JSON"),
        (b"[1, 2]", r'give {"handles": \[group'),
        (b'{"handle": []}', r'give {"handles": \[group'),
        (b'{"handles": {}}', r'give {"handles": \[group'),
        (b'{"handles": []}', "with at least one group"),
        (b"\xff\xfe\x00", "is not a text file"),
        (b'{"handles": [{"vertices": [' + b"9" * 5000 + b"]}]}", "is not valid JSON .Exceeds"),
        (
            b'{"handles": [{"vertices": [' + b"9" * 400 + b"]}]}",
            "handles cannot be read as numbers",
        ),
        (
            b'{"handles": [{"vertices": [0], "translation": [0, 0, ' + b"9" * 400 + b"]}]}",
            "translation cannot be read as numbers: it holds 999",
        ),
        (b'{"handles": [{"vertices": [0], "translation": ["1_0", 0, 0]}]}', "text: give numbers"),
        (b'{"handles": [{"vertices": [1000000000]}]}', "handle 1000000000 .* out of range"),
        (b'{"handles": [{"vertices": [0], "\\u001b[31m' + b"a" * 9999 + b'": 1}]}', "unknown key"),
    ],
)
def test_bad_json_is_named(tmp_path, bar, content, message):
    path = tmp_path / "handles.json"
    path.write_bytes(content)
    with pytest.raises(jd.InputError, match=message) as error:
        jd.load_handles(path, bar)
    assert str(path) in str(error.value)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 1000


def test_a_byte_order_mark_does_no_harm(tmp_path, bar):
    path = tmp_path / "handles.JSON"
    path.write_text(json.dumps({"handles": [GOOD]}), encoding="utf-8-sig")
    assert jd.load_handles(path, bar).handles.tolist() == [0, 1]
    path = tmp_path / "arm.tgf"
    path.write_text("1 0 0 0\n2 0 1 0\n#\n1 2\n", encoding="utf-8-sig")
    np.testing.assert_array_equal(jd.load_skeleton(path).joints, [[0, 0, 0], [0, 1, 0]])


MATRIX = "# moves\n1 0 0 10\n0 0 -1 0\n\n0 1 0 -5\n0 0 0 1\n"


def survey(tmp_path, status, matrix=MATRIX):
    (tmp_path / "h.sel").write_text("# status\n" + status)
    (tmp_path / "h.def").write_text(matrix)
    return tmp_path / "h.sel"


def test_survey_files(tmp_path):
    mesh = jd.shapes.square()
    path = survey(tmp_path, "0 1 2\n1 1 1\n2\n1\n0 # last\n")
    handles, targets = jd.load_handles(path, mesh)
    assert handles.tolist() == [0, 2, 6, 8]
    v = mesh.vertices[handles]
    np.testing.assert_allclose(targets[[0, 3]], v[[0, 3]], atol=EXACT)
    want = np.stack([v[:, 0] + 10, -v[:, 2], v[:, 1] - 5], axis=1)
    np.testing.assert_allclose(targets[[1, 2]], want[[1, 2]], atol=EXACT)
    other = tmp_path / "other.def"
    other.write_text("1 0 0 0\n0 1 0 0\n0 0 1 1\n0 0 0 1\n")
    np.testing.assert_allclose(
        jd.load_handles(path, mesh, other).targets, v + [[0, 0, k] for k in (0, 1, 1, 0)]
    )


def test_bad_survey_files_are_named(tmp_path):
    mesh = jd.shapes.square()
    good = "0 1 2 1 1 1 2 1 0"
    bad = {
        "h.sel: has 8 numbers, but the mesh has 9 vertices": (good[2:], MATRIX),
        "h.sel: vertex 4 is '3': give 0 .fixed., 1": ("0 1 2 1 3 1 2 1 0", MATRIX),
        "h.sel: vertex 0 is 'x'": ("x 1 2 1 1 1 2 1 0", MATRIX),
        r"h.sel: vertex 1 is 'x{56}\.\.\.: give 0": (f"0 {'x' * 20_000} 2 1 1 1 2 1 0", MATRIX),
        "h.sel: no handles": ("1 " * 9, MATRIX),
        "h.def: the matrix: give 4 x 4 finite numbers": (good, MATRIX[:-8]),
        "h.def: the matrix cannot be read as numbers": (good, MATRIX + "1\n"),
        "h.def: the matrix: the moved points overflow": (
            good,
            "1e308 0 0 1e308\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
        ),
        r"h\.def: the matrix: give numbers": (good, MATRIX.replace("10", "1_0")),
        "h.def: the matrix: give 4 x 4 finite": (good, MATRIX.replace("10", "inf")),
        "h.def: the matrix ends in the row": (good, "1 0 0 0\n0 1 0 0\n0 0 1 0\n1 2 3 1\n"),
    }
    for message, (status, matrix) in bad.items():
        with pytest.raises(jd.InputError, match=message):
            jd.load_handles(survey(tmp_path, status, matrix), mesh)
    path = survey(tmp_path, good)
    with pytest.raises(jd.InputError, match=r"none.def: cannot be read \(No such file"):
        jd.load_handles(path, mesh, tmp_path / "none.def")
    (tmp_path / "h.def").unlink()
    with pytest.raises(jd.InputError, match=r"h.def: cannot be read"):
        jd.load_handles(path, mesh)


def test_other_files(tmp_path, bar):
    for name, message in {
        "none.json": "cannot be read .No such file",
        "none.sel": "cannot be read .No such file",
        "h.txt": "end in .json or .sel, not '.txt'",
    }.items():
        with pytest.raises(jd.InputError, match=message):
            jd.load_handles(tmp_path / name, bar)
    with pytest.raises(jd.InputError, match=r"holds its motions itself: leave out x\.def"):
        jd.load_handles(write(tmp_path, GOOD), bar, "x.def")


def test_the_survey_s_cylinder():
    mesh = real_mesh("cylinder.off")
    handles, targets = jd.load_handles(REAL / "cylinder.sel", mesh)
    words = [
        word
        for line in (REAL / "cylinder.sel").read_text().splitlines()
        if not line.startswith("#")
        for word in line.split()
    ]
    assert handles.tolist() == [k for k, word in enumerate(words) if word != "1"]
    fixed = np.array([words[k] == "0" for k in handles])
    assert 0 < fixed.sum() < len(handles)
    v = mesh.vertices[handles]
    np.testing.assert_array_equal(targets[fixed], v[fixed])
    # The file says so: 120 degrees about y, to six digits, and a shift.
    turn = turned(v[~fixed], [0, -1, 0], 120, np.zeros(3)) + np.array([5.196152, 0, 9])
    np.testing.assert_allclose(targets[~fixed], turn, atol=1e-5)


def test_a_long_word_takes_no_more_memory_than_it_is_long(tmp_path):
    """An array of words would give each the room of the longest: here 400 MB."""
    mesh = jd.shapes.cylinder()
    words = ["1"] * mesh.n_vertices
    words[7] = "x" * 20_000
    path = survey(tmp_path, " ".join(words))
    tracemalloc.start()
    with pytest.raises(jd.InputError, match="vertex 7 is 'xxx"):
        jd.load_handles(path, mesh)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 30 * path.stat().st_size
