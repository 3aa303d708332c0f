"""The manifest of a batch run: one job a row, checked as a whole before anything starts."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxdeform as jd
from jaxdeform._apps.methods import Method
from jaxdeform._errors import a_or_an, shown
from jaxdeform._mesh.expressions import matching
from jaxdeform._mesh.reading import read_bytes, read_text
from jaxdeform._mesh.words import real

# The results of a run are those of methods that have an energy.
_METHODS = [str(method) for method in Method if method.has_energy]


class Job(NamedTuple):
    """One row: a deformation, or a fit where it has poses. Paths are absolute, None is blank."""

    job: str
    mesh: str
    handles: str | None = None
    fix: str | None = None
    move: str | None = None
    rotate: tuple[str, float] | None = None
    about: tuple[float, ...] | None = None
    translate: tuple[float, ...] | None = None
    frames: int | None = None
    method: str = "material"
    rigidity: str | None = None
    stiff: tuple[str, ...] = ()
    rings: int = 1
    poses: tuple[str, ...] = ()
    alpha: float | None = None

    @property
    def problem(self) -> tuple[Any, ...]:
        """What jobs of one factor have in common."""
        spokes = Method(self.method).has_spokes
        return self.mesh, self.handles, self.fix, self.move, self.rings, spokes

    def as_json(self) -> str:
        """Return the row as text, and nothing that is blank."""
        values = {k: v for k, v in self._asdict().items() if v not in (None, ())}
        return json.dumps(values)

    @staticmethod
    def of_json(text: str) -> "Job":
        """Return what `as_json` wrote."""
        read = json.loads(text)
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in read.items()
        }
        return Job(**values)

    @property
    def files(self) -> list[str]:
        """The files that it reads."""
        named = [self.mesh, self.handles, *self.poses]
        if self.rigidity and _number(self.rigidity) is None:
            named.append(self.rigidity)
        return [name for name in named if name]


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
        yield from reader
    elif suffix in (".jsonl", ".ndjson"):
        for number, line in enumerate(read_text(path).splitlines(), 1):
            if line.strip():
                yield _object(path, number, line)
    elif suffix == ".parquet":
        import pyarrow.parquet

        data = io.BytesIO(read_bytes(path))
        try:
            yield from pyarrow.parquet.read_table(data).to_pylist()
        except (OSError, ValueError) as error:
            raise jd.InputError(f"{path}: is no Parquet file ({error}): write it again") from error
    else:
        raise jd.InputError(f"{path}: is no manifest: give a .csv, .jsonl or .parquet file")


def _object(path: Path, number: int, line: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
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
        if column not in _READERS:
            columns = ", ".join(_READERS)
            raise jd.InputError(f"{where}: {shown(column)} is no column: there are {columns}")
        blank = value is None or value == [] or (isinstance(value, str) and not value.strip())
        if not blank and not (isinstance(value, float) and math.isnan(value)):
            key = column, repr(value)
            if key not in read:
                try:
                    read[key] = _READERS[column](value, folder)
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


# ---------------------------------------------------------------- one reader a column


def _name(value: Any, folder: Path) -> str:
    name = str(value).strip()
    if name in (".", "..") or set(name) & set('/\\:*?"<>|\0') or not name.isprintable():
        raise jd.InputError(f"{shown(name)} cannot name a file: leave out signs such as / and :")
    return name


def _file(value: Any, folder: Path) -> str:
    if not isinstance(value, str):
        raise jd.InputError(f"is {a_or_an(value)}: give the name of a file")
    try:
        path = (folder / value.strip()).resolve()
        found = path.is_file()
    except (OSError, ValueError) as error:
        raise jd.InputError(f"{shown(value)} is no name of a file ({error})") from error
    if not path.is_relative_to(folder):
        raise jd.InputError(
            f"{shown(value)} is outside the manifest's folder: put it beside the manifest"
        )
    if not found:
        raise jd.InputError(f"there is no file {path}: check the name")
    return str(path)


def _files(value: Any, folder: Path) -> tuple[str, ...]:
    return tuple(_file(one, folder) for one in _listed(value, ";"))


# A solid, on which every expression that can be read has a value.
_SOLID = jd.Mesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def _expression(value: Any, folder: Path) -> str:
    matching(_SOLID, value, "the expression")
    return value.strip()


def _numbers(value: Any, count: int) -> tuple[float, ...]:
    words = _listed(value, None)
    numbers = [_number(word) for word in words]
    if len(numbers) != count or None in numbers:
        raise jd.InputError(f"{shown(value)}: give {count} numbers, such as 0 0.5 1")
    return tuple(x for x in numbers if x is not None)


def _point(value: Any, folder: Path) -> tuple[float, ...]:
    return _numbers(value, 3)


def _rotation(value: Any, folder: Path) -> tuple[str, float]:
    words = _listed(value, None)
    degrees = _number(words[-1]) if len(words) == 2 else None
    if degrees is None or words[0] not in ("x", "y", "z"):
        raise jd.InputError(f"{shown(value)}: give an axis and degrees, such as z 60")
    return str(words[0]), degrees


def _listed(value: Any, mark: str | None) -> list[Any]:
    return value.split(mark) if isinstance(value, str) else list(np.atleast_1d(value).tolist())


def _number(word: Any) -> float | None:
    try:
        number = real(str(word).strip().encode(errors="replace"))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _count(value: Any, folder: Path) -> int:
    number = None if isinstance(value, bool) else _number(value)
    if number is None or number != int(number) or not 1 <= number <= 9999:
        raise jd.InputError(f"{shown(value)}: give a whole number from 1 to 9999")
    return int(number)


def _method(value: Any, folder: Path) -> str:
    if value not in _METHODS:
        raise jd.InputError(f"{shown(value)} is no method: there are {', '.join(_METHODS)}")
    return value


def _alpha(value: Any, folder: Path) -> float:
    number = _number(value)
    if number is None or number < 0:
        raise jd.InputError(f"{shown(value)}: give a number, 0 or more")
    return number


def _rigidity(value: Any, folder: Path) -> str:
    number = _number(value)
    if number is None:
        return _file(value, folder)
    if number < 0:
        raise jd.InputError(f"{shown(value)}: give a number, 0 or more, or a PLY file")
    return repr(number)


def _regions(value: Any, folder: Path) -> tuple[str, ...]:
    found = []
    for region in _listed(value, ";"):
        expression, _, word = str(region).rpartition(":")
        number = _number(word)
        if number is None or number < 0:
            raise jd.InputError(f"{shown(region)}: give EXPR: VALUE, such as y > 0.5: 30")
        found.append(f"{_expression(expression, folder)}: {number!r}")
    return tuple(found)


_READERS: dict[str, Callable[[Any, Path], Any]] = {
    "job": _name,
    "mesh": _file,
    "handles": _file,
    "fix": _expression,
    "move": _expression,
    "rotate": _rotation,
    "about": _point,
    "translate": _point,
    "frames": _count,
    "method": _method,
    "rigidity": _rigidity,
    "stiff": _regions,
    "rings": _count,
    "poses": _files,
    "alpha": _alpha,
}
