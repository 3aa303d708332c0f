"""What a run has come to: a table and a few words."""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.batch.place import is_address
from jaxdeform._apps.batch.store import Root
from jaxdeform._mesh.writing import write_atomically


class Count(NamedTuple):
    """How far a run is."""

    done: int
    failed: int
    total: int


def count(root: Root, jobs: list[Job]) -> Count:
    codes = np.concatenate([group["result"][:] for group in store.groups(root)])
    done = codes != store.WAITING
    return Count(int(done.sum()), int((codes == store.FAILED).sum()), len(jobs))


def table(root: Root, jobs: list[Job]) -> dict[str, list[Any]]:
    """Return a column for each value of a job, in the order of the manifest."""
    errors = store.errors_of(root)
    columns: dict[str, list[Any]] = {
        name: [None] * len(jobs)
        for name in ("job", "mesh", "result", "energy", "misfit", "steps", "flipped", "seconds")
    }
    columns["error"] = [errors.get(row) for row in range(len(jobs))]
    for group in store.groups(root):
        rows = group["row"][:]
        scalars = {name: group[name][:].tolist() for name in store.SCALARS}
        for place, row in enumerate(rows):
            code = scalars["result"][place]
            columns["job"][row], columns["mesh"][row] = jobs[row].job, Path(jobs[row].mesh).name
            if code == store.WAITING:
                continue
            for name, values in scalars.items():
                value = values[place]
                columns[name][row] = None if value != value else value
            columns["result"][row] = store.CODES[code]
    return columns


def tables(run: str, as_csv: bool) -> list[str]:
    """Return the names of the tables of a run: Parquet, and on request CSV."""
    return [f"{run.rstrip('/')}/summary.{suffix}" for suffix in ("parquet", "csv")[: 1 + as_csv]]


def has_tables(run: str, as_csv: bool) -> bool:
    """Whether the tables are there. They are written last: the run was finished then."""
    import fsspec.core

    places = [fsspec.core.url_to_fs(name) for name in tables(run, as_csv)]
    return all(files.exists(path) for files, path in places)


def write_tables(run: str, columns: dict[str, list[Any]], as_csv: bool) -> None:
    """Write the tables."""
    import fsspec
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    kinds: dict[str, Any] = {name: pyarrow.string() for name in ("job", "mesh", "result", "error")}
    kinds |= {name: pyarrow.float64() for name in ("energy", "misfit", "seconds")}
    kinds |= {name: pyarrow.int64() for name in ("steps", "flipped")}
    content = pyarrow.table({k: pyarrow.array(v, kinds[k]) for k, v in columns.items()})
    writers = {".parquet": pyarrow.parquet.write_table, ".csv": pyarrow.csv.write_csv}
    for place in tables(run, as_csv):
        file = io.BytesIO()
        writers[Path(place).suffix](content, file)
        if is_address(run):
            with fsspec.open(place, "wb") as remote:
                remote.write(file.getvalue())  # pyright: ignore[reportAttributeAccessIssue]
        else:
            write_atomically(Path(place), file.getvalue())
