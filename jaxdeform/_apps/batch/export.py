"""The results of a run as meshes, one file a job."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import jaxdeform as jd
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.batch.store import Root
from jaxdeform._apps.results import rescue_of, save_result
from jaxdeform._mesh.files import check_output, format_of


def export(
    run: str, root: Root, jobs: list[Job], folder: Path, suffix: str
) -> Iterator[str | None]:
    """Write the mesh of each job that has one; tell of each why it could not be written, or None.

    **Raises** InputError before anything is written: a mesh file has changed since the run was
    begun, or would be written over.
    """
    format_of(Path(f"x{suffix}"))
    done = [(group, *_done(group)) for group in store.groups(root)]
    out_of = lambda row: folder / f"{jobs[row].job}{suffix}"  # noqa: E731
    store.check_files(run, root, {jobs[row].mesh for _, _, rows in done for row in rows})
    _check_inputs(list(root.attrs["files"]), [out_of(row) for _, _, rows in done for row in rows])
    for group, places, rows in done:
        if not places:
            continue
        mesh = jd.load_mesh(jobs[rows[0]].mesh)
        for place, row in zip(places, rows, strict=True):
            vertices, rigidity = group["vertices"][place], group["rigidity"][place]
            if jobs[row].poses:
                vertices = mesh.vertices
            if not np.isfinite(vertices).all():
                continue
            yield _failure(out_of(row), mesh, vertices, rigidity)


def _failure(out: Path, mesh: jd.Mesh, vertices: np.ndarray, rigidity: np.ndarray) -> str | None:
    """Write a mesh; where that fails, return why."""
    try:
        check_output(out, mesh)
        save_result(out, mesh, vertices, rigidity if format_of(out) == ".ply" else None)
    except jd.InputError as error:
        return str(error)
    return None


def _done(group: Root) -> tuple[list[int], list[int]]:
    """Return the jobs that did not fail: their places in the group, and their rows."""
    codes, rows = group["result"][:], group["row"][:]
    places = np.flatnonzero((codes != store.WAITING) & (codes != store.FAILED))
    return places.tolist(), rows[places].tolist()


def _check_inputs(inputs: list[str], outs: list[Path]) -> None:
    """Raise InputError if a file that the run reads would be written over, also by a link."""
    names = {_place(path): path for path in map(Path, inputs) if path.exists()}
    for out in outs:
        for path in (out, rescue_of(out)):
            if os.path.exists(path) and _place(path) in names:
                raise jd.InputError(
                    f"{path}: is {names[_place(path)]}, which the run reads: give another folder "
                    "to -o"
                )


def _place(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino
