"""The manifest of a batch run: one job a row, checked as a whole before anything starts."""

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jaxdeform as jd
from jaxdeform._apps.batch.columns import READERS
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.methods import Method
from jaxdeform._errors import a_or_an, shown
from jaxdeform._mesh.reading import read_bytes, read_text


def read_manifest(path: Path) -> list[Job]:
    """Return the jobs of a CSV, JSON lines or Parquet file.

    **Raises** InputError naming the row and the column: an unknown column, a missing file or one
    outside the manifest's folder, a value that does not fit its column, two jobs of one name.
    """
    rows = list(_rows(path))
    if not rows:
        raise jd.InputError(f"{path}: has no rows: give one row a job")
    folder = path.resolve().parent
    jobs: list[Job] = []
    seen: dict[str, int] = {}
    read: dict[tuple[str, str], Any] = {}
    for number, row in enumerate(rows, 1):
        where = f"{path}: row {number}"
        job = _job(where, number, row, folder, read)
        if job.job in seen:
            raise jd.InputError(
                f"{where}: the job {shown(job.job)} is in row {seen[job.job]} too: give each row "
                "a name of its own"
            )
        seen[job.job] = number
        jobs.append(job)
    return jobs


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    suffix = path.suffix.lower()
    if suffix == ".csv":
        text = io.StringIO(read_text(path), newline="")
        reader = csv.DictReader(text, restkey="(beyond the last column)")
        try:
            _check_once(str(path), reader.fieldnames or [])
            yield from reader
        except csv.Error as error:
            raise jd.InputError(
                f"{path}: cannot be read behind line {reader.line_num} ({error}): correct it, or "
                "write JSON lines"
            ) from error
    elif suffix in (".jsonl", ".ndjson"):
        for number, line in enumerate(read_text(path).split("\n"), 1):
            if line.strip():
                yield _object(path, number, line)
    elif suffix == ".parquet":
        import pyarrow.parquet

        data = io.BytesIO(read_bytes(path))
        try:
            file = pyarrow.parquet.ParquetFile(data)
            columns, rows = file.schema_arrow.names, file.read().to_pylist()
        except (OSError, ValueError) as error:
            raise jd.InputError(f"{path}: is no Parquet file ({error}): write it again") from error
        _check_once(str(path), columns)
        yield from rows
    else:
        raise jd.InputError(f"{path}: is no manifest: give a .csv, .jsonl or .parquet file")


def _check_once(where: str, columns: Sequence[str]) -> None:
    """Raise InputError where a column is there twice: only one of them would be read."""
    for column, times in Counter(columns).items():
        if times > 1:
            raise jd.InputError(
                f"{where}: the column {shown(column)} is there {times} times: give it once "
                "(several regions or poses go into one cell, separated by ;)"
            )


def _object(path: Path, number: int, line: str) -> dict[str, Any]:
    def read(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        _check_once(f"{path}: line {number}", [key for key, _ in pairs])
        return dict(pairs)

    try:
        row = json.loads(line, object_pairs_hook=read)
    except jd.InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise jd.InputError(f"{path}: line {number} is not JSON ({error})") from error
    if not isinstance(row, dict):
        raise jd.InputError(f"{path}: line {number} is {a_or_an(row)}: give an object, {{...}}")
    return row


def _job(
    where: str, number: int, row: dict[str, Any], folder: Path, read: dict[tuple[str, str], Any]
) -> Job:
    """Return a checked row. `read` has what the rows above it held, which is mostly the same."""
    values: dict[str, Any] = {"job": str(number)}
    for column, value in row.items():
        if column not in READERS:
            move = f"there are {', '.join(READERS)}"
            if column.startswith("__index_level_"):  # as pandas writes it
                move = "write the table with index=False"
            raise jd.InputError(f"{where}: {shown(column)} is no column: {move}")
        blank = value is None or value == [] or (isinstance(value, str) and not value.strip())
        if not blank and not (isinstance(value, float) and math.isnan(value)):
            key = column, repr(value)
            if key not in read:
                try:
                    read[key] = READERS[column](value, folder)
                except jd.InputError as error:
                    raise jd.InputError(f"{where}, {column}: {error}") from error
            values[column] = read[key]
    if "mesh" not in values:
        raise jd.InputError(f"{where}: has no mesh: name its file")
    job = Job(**values)
    _check_together(where, job)
    return job


def _check_together(where: str, job: Job) -> None:
    placed = [
        name for name in ("fix", "move", "rotate", "about", "translate") if getattr(job, name)
    ]
    if job.handles and placed:
        raise jd.InputError(
            f"{where}: {placed[0]} and handles exclude each other: give one of them"
        )
    if not (job.handles or job.move or (job.poses and job.fix)):
        raise jd.InputError(
            f"{where}: no vertices are chosen: give handles (a file), or fix and move"
        )
    if job.poses and (job.rotate or job.translate or job.frames or job.rigidity or job.stiff):
        raise jd.InputError(
            f"{where}: with poses the rigidity is estimated: leave out rotate, translate, frames, "
            "rigidity and stiff"
        )
    if job.move and not (job.poses or job.rotate or job.translate):
        raise jd.InputError(f"{where}: move needs rotate, translate, or both")
    if job.about and not job.rotate:
        raise jd.InputError(f"{where}: about is the centre of a rotation: give rotate")
    if not Method(job.method).has_rigidity and (job.rigidity or job.stiff or job.poses):
        raise jd.InputError(f"{where}: {job.method} has no rigidity: leave out rigidity and stiff")
    if job.method != Method.sr_arap and job.alpha is not None:
        raise jd.InputError(f"{where}: {job.method} has no alpha: leave it out")
