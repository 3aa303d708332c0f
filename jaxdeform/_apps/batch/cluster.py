"""The workers of a batch run: blocks are handed out, and given again where a worker is lost."""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import dask.config
from distributed import Client, LocalCluster, as_completed
from distributed.scheduler import KilledWorker

import jaxdeform as jd
from jaxdeform._apps.batch.store import Block
from jaxdeform._apps.batch.worker import WorkerSettings, run_block


def work_off(
    blocks: list[Block],
    settings: WorkerSettings,
    scheduler: str | None,
    workers: int,
    tell: Callable[[int], Any],
    say: Callable[[str], Any],
) -> None:
    """Do all jobs of the blocks; tell how many are done.

    **Raises** InputError where results cannot be written, or no worker can be had.
    """
    done = 0
    with _client(scheduler, workers, settings, say) as client:
        lost: dict[str, int] = {}
        of_future = {client.submit(run_block, x, settings, pure=False): x for x in blocks}
        queue = as_completed(of_future)
        for future in queue:
            block = of_future.pop(future)
            error = future.exception()
            if error is None:
                done += len(block.jobs)
                tell(done)
                continue
            lost[block.key] = lost.get(block.key, 0) + 1
            most = settings.tries * (len(block.jobs) + 1)
            if not isinstance(error, KilledWorker) or lost[block.key] > most:
                raise jd.InputError(
                    f"{settings.run}: the run stopped ({type(error).__name__}: {error}). What is "
                    "done is kept: repair it, and run the same command again"
                ) from error
            again = client.submit(run_block, block, settings, pure=False)
            of_future[again] = block
            queue.add(again)


@contextmanager
def _client(
    scheduler: str | None, workers: int, settings: WorkerSettings, say: Callable[[str], Any]
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
    # After Ctrl-C the tracker of multiprocessing tidies up, and would tell of every semaphore.
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")
    with dask.config.set(
        {
            # A block that loses its worker is tried again; worker.py counts how often.
            "distributed.scheduler.allowed-failures": settings.tries * 100,
            # It keeps the call stacks of the last 1,000 s: 5 KiB for each small job.
            "distributed.worker.profile.enabled": False,
        }
    ):
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
