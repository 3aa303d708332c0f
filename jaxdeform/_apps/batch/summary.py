"""What a run has come to: a table, a few words, and meshes."""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxdeform as jd
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.manifest import Job
from jaxdeform._apps.batch.store import Root
from jaxdeform._apps.results import save_result
from jaxdeform._mesh.files import check_output, format_of
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


def table(root: Root, jobs: list[Job]) -> dict[str, list]:
    """Return a column for each value of a job, in the order of the manifest."""
    errors = store.errors_of(root)
    columns: dict[str, list] = {
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


def write_table(run: str, columns: dict[str, list], as_csv: bool) -> list[str]:
    """Write the table as Parquet, and on request as CSV; return the names."""
    import fsspec
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    kinds: dict[str, Any] = {name: pyarrow.string() for name in ("job", "mesh", "result", "error")}
    kinds |= {name: pyarrow.float64() for name in ("energy", "misfit", "seconds")}
    kinds |= {name: pyarrow.int64() for name in ("steps", "flipped")}
    content = pyarrow.table({k: pyarrow.array(v, kinds[k]) for k, v in columns.items()})
    writers = {"summary.parquet": pyarrow.parquet.write_table}
    if as_csv:
        writers["summary.csv"] = pyarrow.csv.write_csv
    names = []
    for name, write in writers.items():
        file, place = io.BytesIO(), f"{run.rstrip('/')}/{name}"
        write(content, file)
        if "://" in run:
            with fsspec.open(place, "wb") as remote:
                remote.write(file.getvalue())  # pyright: ignore[reportAttributeAccessIssue]
        else:
            write_atomically(Path(place), file.getvalue())
        names.append(place)
    return names


def export(root: Root, jobs: list[Job], folder: Path, suffix: str) -> int:
    """Write the mesh of each job that has one, and return how many."""
    format_of(Path(f"x{suffix}"))
    written = 0
    for group in store.groups(root):
        results, rows = group["result"][:], group["row"][:]
        good = [p for p in range(len(rows)) if results[p] not in (store.WAITING, store.FAILED)]
        if not good:
            continue
        mesh = jd.load_mesh(str(group.attrs["mesh"]))
        for place in good:
            vertices, rigidity = group["vertices"][place], group["rigidity"][place]
            if jobs[rows[place]].poses:
                vertices = mesh.vertices
            if not np.isfinite(vertices).all():
                continue
            out = folder / f"{jobs[rows[place]].job}{suffix}"
            check_output(out, mesh)
            save_result(out, mesh, vertices, rigidity if suffix == ".ply" else None)
            written += 1
    return written
