"""A batch run: plan, hand out blocks to workers, go on where it was interrupted."""

import logging
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import dask.config
from distributed import Client, LocalCluster, as_completed
from distributed.scheduler import KilledWorker

import jaxdeform as jd
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.manifest import Job
from jaxdeform._apps.batch.store import Root
from jaxdeform._apps.batch.worker import Settings, run_block


def planned(run: str, jobs: list[Job]) -> Root:
    """Return the store of the run: that of an earlier try with the same jobs, or a new one."""
    root = store.find(run)
    if root is None:
        if "://" not in run and _holds_something(Path(run)):
            raise jd.InputError(f"{run}: is a folder with other files in it: choose a new name")
        return store.make(run, jobs)
    if not store.is_run(root):
        raise jd.InputError(f"{run}: holds a Zarr store that is no run: choose a new name")
    if not root.attrs.get("complete"):  # interrupted before its first job
        return store.make(run, jobs)
    store.check_same(run, root, jobs)
    return root


def _holds_something(run: Path) -> bool:
    """Whether a folder has files in it, other than those of a run killed at its first write."""
    files = [file for file in run.rglob("*") if not file.is_dir()]
    begun = [file for file in files if file.parent.name == store.FOLDER]
    return len(begun) < len(files) or any(file.suffix != ".partial" for file in begun)


def go_on(
    root: Root,
    jobs: list[Job],
    settings: Settings,
    scheduler: str | None,
    workers: int,
    tell: Callable[[int, int], Any],
    say: Callable[[str], Any],
) -> bool:
    """Do all jobs that are not done, and return whether there were any.

    Nothing is lost where it is interrupted.

    **Raises** InputError where results cannot be written, or no worker can be had.
    """
    listed = list(store.blocks(root, jobs))
    todo = [block for block, done in listed if not done]
    finished = len(jobs) - sum(len(block.jobs) for block in todo)
    tell(finished, len(jobs))
    if not todo:
        return False
    with _client(scheduler, min(workers, len(todo)), settings, say) as client:
        lost: dict[str, int] = {}
        of_future = {client.submit(run_block, x, settings, pure=False): x for x in todo}
        queue = as_completed(of_future)
        for future in queue:
            block = of_future.pop(future)
            error = future.exception()
            if error is None:
                finished += len(block.jobs)
                tell(finished, len(jobs))
                continue
            lost[block.key] = lost.get(block.key, 0) + 1
            most = settings.tries * (len(block.jobs) + 1)
            if not isinstance(error, KilledWorker) or lost[block.key] > most:
                raise jd.InputError(
                    f"{settings.run}: the run stopped ({type(error).__name__}: {error}). What is "
                    "done is kept: mend it, and run the same command again"
                ) from error
            again = client.submit(run_block, block, settings, pure=False)
            of_future[again] = block
            queue.add(again)
    return True


@contextmanager
def _client(
    scheduler: str | None, workers: int, settings: Settings, say: Callable[[str], Any]
) -> Iterator[Client]:
    """Connect to the scheduler, or start workers of our own, which only this machine can reach."""
    for name in ("distributed", "tornado", "asyncio"):  # a lost worker is part of the plan
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=30)
        except (OSError, ValueError) as error:
            raise jd.InputError(
                f"--scheduler {scheduler}: cannot be reached ({error}): start one with 'dask "
                "scheduler', and workers with 'dask worker'"
            ) from error
        with client:
            say(f"dashboard: {client.dashboard_link}")
            yield client
        return
    # A block that loses its worker is tried again; worker.py counts how often.
    with dask.config.set({"distributed.scheduler.allowed-failures": settings.tries * 100}):
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,  # JAX has its own
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                env={"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
        except Exception as error:  # whatever Dask raises where a worker dies at its start
            raise jd.InputError(
                f"the workers could not be started ({type(error).__name__}: {error}): run the same "
                "command again"
            ) from error
        with cluster, Client(cluster) as client:
            say(f"{workers} workers, dashboard: {client.dashboard_link}")
            yield client


def new_session() -> str:
    return secrets.token_hex(8)
