"""What a worker does: one block of jobs, of which a bad one does not end the others."""

import os
import re
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

import jax

import jaxdeform as jd
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.job import Job
from jaxdeform._apps.batch.work import Done, do

# What the command `deform` has as options is columns here, of the same names.
_OPTION = re.compile(rf"(?<!\S)--({'|'.join(Job._fields)})\b")


class WorkerSettings(NamedTuple):
    """How a run goes; another run of the same jobs may have other ones."""

    run: str
    session: str
    """Of the command that is at work: tries are counted anew where it is started again."""
    tries: int
    seconds: float
    """The longest that a job may take."""
    cache: bool


def run_block(block: store.Block, settings: WorkerSettings) -> int:
    """Do the jobs of a block that is not done yet, write the results, and return their number."""
    jax.config.update("jax_enable_x64", True)
    if settings.cache:
        with suppress(jd.InputError):
            jd.enable_compilation_cache()
    root = store.opened(settings.run)
    noted = store.began(root, block) or {}
    again = noted.get("session") == settings.session
    counts = noted.get("counts", {}) if again else {}
    if not again:
        store.note(root, block, {"session": settings.session, "counts": {}})
    done: list[Done | str] = []
    for row, job in zip(block.rows, block.jobs, strict=True):
        if again:  # a worker was lost at this block: find out at which job
            counts[str(row)] = counts.get(str(row), 0) + 1
            if counts[str(row)] >= settings.tries:
                done.append(
                    f"it ended {settings.tries} workers: it takes too much memory, or more than "
                    f"{settings.seconds:g} s"
                )
                continue
            store.note(root, block, {"session": settings.session, "counts": counts})
        with _limited(settings.seconds):
            done.append(_tried(job))
        if again:
            counts[str(row)] -= 1
    store.check_files(settings.run, root, {name for job in block.jobs for name in job.files})
    store.write(root, block, done)
    store.forget(root, block)
    return len(done)


def _tried(job) -> Done | str:
    try:
        return do(job)
    except jd.InputError as error:
        return _OPTION.sub(r"\1", str(error))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({where.name}, line {where.lineno})"


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """End the process, which cannot be talked to while it computes, when the time is over."""
    timer = threading.Timer(seconds, os._exit, [75])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
