"""The command ``jaxdeform batch``."""

import os
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import typer

import jaxdeform as jd
from jaxdeform._apps.arguments import make_folder
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._apps.talk import complain, console, counted, patiently, since
from jaxdeform._errors import printable

MISSING = "jaxdeform batch needs further packages: pip install 'jaxdeform[batch]'"


def batch(
    manifest: Annotated[
        Path | None, typer.Argument(help="CSV, JSON lines or Parquet file: one job a row.")
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder of the run (or an fsspec address); with --export, of meshes.",
        ),
    ] = None,
    status: Annotated[
        str | None, typer.Option(metavar="RUN", help="Say how far a run is, and do nothing.")
    ] = None,
    export: Annotated[
        str | None, typer.Option(metavar="RUN", help="Write the results of a run as meshes.")
    ] = None,
    suffix: Annotated[str, typer.Option("--format", help="Their format.")] = "ply",
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A Dask scheduler; by default workers of our own."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes of our own. By default one for two CPUs."),
    ] = None,
    tries: Annotated[
        int, typer.Option(min=2, help="Give a job up that has ended so many workers.")
    ] = 3,
    time_limit: Annotated[
        float, typer.Option(min=1.0, help="The longest that a job may take, in seconds.")
    ] = 3600.0,
    csv: Annotated[bool, typer.Option("--csv", help="Write the summary as CSV too.")] = False,
) -> None:
    """Do many jobs: deformations and fits of many meshes. The same command goes on after a stop."""
    missing = [name for name in ("distributed", "pyarrow", "zarr") if find_spec(name) is None]
    if missing:
        raise jd.InputError(f"{MISSING} (there is no {', no '.join(missing)})")
    if status is not None:
        _tell(status)
    elif not out:
        raise jd.InputError("give the folder of the run with -o")
    elif export is not None:
        _export(export, Path(out), f".{suffix.lstrip('.').lower()}")
    elif manifest is None:
        raise jd.InputError("give a manifest: a CSV, JSON lines or Parquet file")
    else:
        count = workers or max(1, (os.cpu_count() or 2) // 2)
        _run(manifest, out, _Options(tries, time_limit, scheduler, count, csv))


class _Options(NamedTuple):
    tries: int
    time_limit: float
    scheduler: str | None
    workers: int
    csv: bool


def _existing(name: str) -> tuple[Any, list[Job]]:
    """Return the store and the jobs of a run."""
    from jaxdeform._apps.batch import store
    from jaxdeform._apps.batch.place import check_address

    check_address(name)
    root = store.find(name)
    if root is None or not store.is_run(root) or not root.attrs.get("complete"):
        raise jd.InputError(f"{name}: is no run: give the folder that -o named")
    return root, store.jobs_of(root)


def _tell(run: str) -> None:
    from jaxdeform._apps.batch import summary
    from jaxdeform._apps.batch.place import readable

    with readable(run):
        done, failed, total = summary.count(*_existing(run))
    console.print(f"{done} of {total} jobs done, {failed} of them failed")


def _export(run: str, folder: Path, suffix: str) -> None:
    from jaxdeform._apps.batch.export import export
    from jaxdeform._apps.batch.place import readable

    written = failed = 0
    with readable(run):
        root, jobs = _existing(run)
        make_folder(folder)
        for failure in export(run, root, jobs, folder, suffix):
            if failure is None:
                written += 1
            else:
                failed += 1
                complain(f"jaxdeform: {failure}")
    lost = f"; {failed} could not be written" if failed else ""
    console.print(f"wrote {written} meshes to {printable(str(folder))}{lost}")
    if failed:
        raise typer.Exit(1)


def _run(manifest: Path, out: str, options: _Options) -> None:
    from jaxdeform._apps.batch import run, summary
    from jaxdeform._apps.batch.place import alone, check_address, is_address, readable
    from jaxdeform._apps.batch.worker import WorkerSettings

    began = time.perf_counter()
    check_address(out)
    jobs = read_manifest(manifest)
    with alone(out):
        with readable(out):
            root = patiently("planning", lambda: run.planned(out, jobs))
        cache = bool(jax.config.values.get("jax_compilation_cache_dir"))  # cli.py has set it
        place = out if is_address(out) else os.path.abspath(out)  # workers may be elsewhere
        settings = WorkerSettings(
            place, run.new_session(), options.tries, options.time_limit, cache
        )
        go_on = partial(run.go_on, root, jobs, settings, options.scheduler, options.workers)
        worked = counted("jobs", len(jobs), lambda tell: go_on(tell, console.print))
        with readable(out):
            if worked or not summary.has_tables(out, options.csv):
                summary.write_tables(out, summary.table(root, jobs), options.csv)
            done, failed, total = summary.count(root, jobs)
    console.print(f"{done} of {total} jobs done, {failed} of them failed, in {since(began)}")
    console.print(f"wrote {printable(', '.join(summary.tables(out, options.csv)))}")
    if failed:
        raise typer.Exit(1)
