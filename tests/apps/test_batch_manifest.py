"""A manifest is checked as a whole: one error that names the row, and nothing is started."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.batch.manifest import read_manifest

pyarrow = pytest.importorskip("pyarrow")

ROWS = [
    {"job": "one", "mesh": "bar.off", "fix": "v < 0.1", "move": "v > 0.9", "rotate": "z 60"},
    {
        "job": "two",
        "mesh": "bar.off",
        "handles": "handles.json",
        "rigidity": "3.5",
        "stiff": "y > 75: 30; x < 0: 1",
        "rings": "2",
        "frames": "5",
    },
    {"mesh": "bar.off", "fix": "v < 0.1", "poses": "bar.off; bar.off"},
    {"mesh": "bar.off", "handles": "handles.json", "method": "sr-arap", "alpha": "0.0"},
]


@pytest.fixture
def folder(tmp_path, bar):
    jd.save_mesh(tmp_path / "bar.off", bar)
    (tmp_path / "handles.json").write_text('{"handles": [{"where": "y < 6"}]}')
    (tmp_path.parent / "outside.off").write_text("OFF")
    return tmp_path


def write(folder, rows, kind="csv"):
    path = folder / f"jobs.{kind}"
    if kind == "jsonl":
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
        return path
    columns = {name: None for row in rows for name in row}
    if kind == "parquet":
        import pyarrow.parquet

        table = {name: [row.get(name) for row in rows] for name in columns}
        pyarrow.parquet.write_table(pyarrow.table(table), path)
        return path
    lines = [",".join(columns)]
    lines += [",".join(f'"{row.get(name) or ""}"' for name in columns) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("kind", ["csv", "jsonl", "parquet"])
def test_the_three_formats_give_the_same_jobs(folder, kind):
    one, two, three, four = read_manifest(write(folder, ROWS, kind))
    bar = str((folder / "bar.off").resolve())
    assert (one.job, one.mesh, one.rotate, one.rings) == ("one", bar, ("z", 60.0), 1)
    assert (two.rigidity, two.stiff, two.frames) == ("3.5", ("y > 75: 30.0", "x < 0: 1.0"), 5)
    assert three.job == "3"
    assert three.poses == (bar, bar)
    assert (four.method, four.alpha, one.alpha) == ("sr-arap", 0.0, None)
    jobs = [one, two, three, four]
    assert [Job.of_json(job.as_json()) for job in jobs] == jobs


def test_json_takes_lists_and_numbers(folder):
    row = ROWS[0] | {"rotate": ["x", 30], "translate": [0, 0, 1.5], "rigidity": 2, "rings": 3}
    job = read_manifest(write(folder, [row], "jsonl"))[0]
    assert (job.rotate, job.translate) == (("x", 30.0), (0.0, 0.0, 1.5))
    assert (job.rigidity, job.rings) == ("2.0", 3)


WRONG = {
    "row 1: 'colour' is no column: there are job, mesh": {"colour": "red"},
    "row 2, mesh: there is no file": {"mesh": "none.off"},
    "row 2, mesh: '../outside.off' is outside the manifest's folder": {"mesh": "../outside.off"},
    "row 2: has no mesh": {"mesh": ""},
    "row 2: the job 'one' is in row 1 too": {"job": "one"},
    "row 2, job: 'a/b' cannot name a file": {"job": "a/b"},
    r"row 2, job: '\.\.' cannot name": {"job": ".."},
    r"row 2, job: 'é+\.\.\. is too long for the name of a file: give at most 243": {
        "job": "é" * 122
    },
    "row 2, fix: the expression: it ends where a number": {"fix": "v <"},
    "row 2, rotate: 'q 60': give an axis and degrees": {"rotate": "q 60"},
    "row 2, translate: '1 2': give 3 numbers": {"translate": "1 2"},
    "row 2, translate: 'nan 0 0': give 3 numbers": {"translate": "nan 0 0"},
    "row 2, rigidity: '-1': give a number, 0 or more": {"rigidity": "-1"},
    "row 2, rigidity: there is no file": {"rigidity": "soft"},
    "row 2, rigidity: 'inf': give a number, 0 or more, or a PLY file": {"rigidity": "inf"},
    "row 2, rigidity: 'nan': give a number, 0 or more, or a PLY file": {"rigidity": "nan"},
    "row 2, stiff: 'y > 1': give EXPR: VALUE": {"stiff": "y > 1"},
    "row 2, rings: '0': give a whole number": {"rings": "0"},
    "row 2, frames: '2.5': give a whole number": {"frames": "2.5"},
    "row 2, method: 'bones' is no method": {"method": "bones"},
    "row 2: arap has no rigidity": {"method": "arap", "rigidity": "1"},
    "row 2: sr-arap has no rigidity": {"method": "sr-arap", "stiff": "y > 1: 3"},
    "row 2: rc-arap has no alpha: leave it out": {"method": "rc-arap", "alpha": "0"},
    "row 2, alpha: '-1': give a number, 0 or more": {"method": "sr-arap", "alpha": "-1"},
    "row 2, alpha: 'nan': give a number": {"method": "sr-arap", "alpha": "nan"},
    "row 2: fix and handles exclude each other": {"handles": "handles.json"},
    "row 2: move needs rotate": {"rotate": ""},
    "row 2: no vertices are chosen": {"fix": "", "move": "", "rotate": ""},
    "row 2: about is the centre": {"rotate": "", "translate": "1 0 0", "about": "0 0 0"},
    "row 2: with poses the rigidity is estimated": {"poses": "bar.off"},
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_named(folder, message):
    rows = [ROWS[0], ROWS[0] | {"job": "other"} | WRONG[message]]
    with pytest.raises(jd.InputError, match=message):
        read_manifest(write(folder, rows))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("jobs.csv", "job,mesh\n", "has no rows"),
        ("jobs.csv", "", "is empty"),
        ("jobs.csv", "mesh\nbar.off,1,2\n", "beyond the last column"),
        ("jobs.csv", f"mesh\n{'a' * 131_073}\n", r"read behind line 1 \(field larger than"),
        ("jobs.jsonl", "[1]\n", "line 1 is a list: give an object"),
        ("jobs.jsonl", '{"mesh"\n', "line 1 is not JSON"),
        ("jobs.jsonl", "[" * 100_000, "line 1 is not JSON"),
        ("jobs.parquet", "no table", "is no Parquet file"),
        ("jobs.txt", "a", "is no manifest"),
    ],
)
def test_files_that_are_no_manifest(folder, name, content, message):
    (folder / name).write_text(content)
    with pytest.raises(jd.InputError, match=message):
        read_manifest(folder / name)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ('"rigidity": true', "row 1, rigidity: True: give a number, 0 or more, or a PLY file"),
        ('"rigidity": [1, 2]', r"row 1, rigidity: \[1, 2\]: give a number, 0 or more, or a PLY"),
        ('"rigidity": Infinity', "row 1, rigidity: inf: give a number, 0 or more, or a PLY file"),
        ('"translate": [true, 0, 1]', r"row 1, translate: \[True, 0, 1\]: give 3 numbers"),
        ('"translate": [[0], [0, 1], 1]', r"row 1, translate: .*: give 3 numbers"),
    ],
)
def test_values_of_json_that_do_not_fit(folder, own, message):
    row = json.dumps({"mesh": "bar.off", "handles": "handles.json"})
    (folder / "jobs.jsonl").write_text(f"{row[:-1]}, {own}}}")
    with pytest.raises(jd.InputError, match=message):
        read_manifest(folder / "jobs.jsonl")


def test_a_column_that_is_there_twice_is_refused(folder):
    """Of two, one would be lost without a word."""
    import pyarrow.parquet

    (folder / "jobs.csv").write_text("mesh,handles,stiff,stiff\nbar.off,handles.json,x>0:1,x<0:2\n")
    row = '{"mesh": "bar.off", "handles": "handles.json", "stiff": "x>0:1", "stiff": "x<0:2"}'
    (folder / "jobs.jsonl").write_text(row)
    column = pyarrow.array(["x>0:1"])
    table = pyarrow.Table.from_arrays([column, column], ["stiff", "stiff"])
    pyarrow.parquet.write_table(table, folder / "jobs.parquet")
    for name in ("jobs.csv", "jobs.jsonl", "jobs.parquet"):
        with pytest.raises(jd.InputError, match=r"'stiff' is there 2 times: .* separated by ;"):
            read_manifest(folder / name)


def test_a_table_of_pandas_with_its_index(folder):
    (row,) = ROWS[:1]
    path = write(folder, [row | {"__index_level_0__": 3}], "parquet")
    with pytest.raises(jd.InputError, match=r"'__index_level_0__' is no column: .*index=False"):
        read_manifest(path)


def test_only_a_newline_ends_a_line_of_json(folder):
    """U+2028 may stand in a text; to some programs it ends a line. As a rule DOS has two signs."""
    row = {"mesh": "bar\u2028.off", "handles": "handles.json"}
    (folder / row["mesh"]).write_bytes((folder / "bar.off").read_bytes())
    text = "\r\n".join([json.dumps(row, ensure_ascii=False)] * 2 + [""])
    (folder / "jobs.jsonl").write_text(text, encoding="utf-8")
    jobs = read_manifest(folder / "jobs.jsonl")
    assert [Path(job.mesh).name for job in jobs] == [row["mesh"]] * 2


def test_random_bytes_are_refused_or_read(folder):
    """Nothing but InputError leaves the reader."""
    rng = np.random.default_rng(0)
    good = write(folder, ROWS).read_bytes()
    for k in range(200):
        spoilt = bytearray(good)
        for place in rng.integers(0, len(good), 1 + k % 5):
            spoilt[place] = rng.integers(0, 256)
        (folder / "jobs.csv").write_bytes(bytes(spoilt[: rng.integers(1, len(good) + 1)]))
        with contextlib.suppress(jd.InputError):
            read_manifest(folder / "jobs.csv")
