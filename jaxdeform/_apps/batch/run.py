"""A batch run: plan, and go on where it was interrupted."""

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxdeform as jd
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.batch.place import LOCK, is_address, other_files, readable
from jaxdeform._apps.batch.store import Root
from jaxdeform._apps.batch.worker import WorkerSettings


def planned(run: str, jobs: list[Job]) -> Root:
    """Return the store of the run: that of an earlier try with the same jobs, or a new one."""
    root = store.find(run)
    if root is None:
        if not is_address(run) and _holds_something(Path(run)):
            raise other_files(run)
        return store.make(run, jobs)
    if not store.is_run(root):
        raise jd.InputError(f"{run}: holds a Zarr store that is no run: choose a new name")
    if not root.attrs.get("complete"):  # interrupted before its first job
        return store.make(run, jobs)
    store.check_same(run, root, jobs)
    return root


def _holds_something(run: Path) -> bool:
    """Whether a folder has files in it, other than those of a run killed at its first write."""
    files = [file for file in run.rglob("*") if not file.is_dir() and file.name != LOCK]
    begun = [file for file in files if file.parent.name == store.FOLDER]
    return len(begun) < len(files) or any(file.suffix != ".partial" for file in begun)


def go_on(
    root: Root,
    jobs: list[Job],
    settings: WorkerSettings,
    scheduler: str | None,
    workers: int,
    tell: Callable[[int, int], Any],
    say: Callable[[str], Any],
) -> bool:
    """Do all jobs that are not done, and return whether there were any.

    Nothing is lost where it is interrupted.

    **Raises** InputError where results cannot be written, or no worker can be had.
    """
    with readable(settings.run):
        listed = list(store.blocks(root, jobs))
    todo = [block for block, done in listed if not done]
    finished = len(jobs) - sum(len(block.jobs) for block in todo)
    tell(finished, len(jobs))
    if not todo:
        return False
    from jaxdeform._apps.batch.cluster import work_off  # Dask takes half a second to import

    work_off(
        todo,
        settings,
        scheduler,
        min(workers, len(todo)),
        lambda done: tell(finished + done, len(jobs)),
        say,
    )
    return True


def new_session() -> str:
    return secrets.token_hex(8)
