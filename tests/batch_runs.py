"""Batch runs in the process of the tests."""

from jaxdeform._apps.batch import run as runs
from jaxdeform._apps.batch import store
from jaxdeform._apps.batch.worker import WorkerSettings, run_block


def settings(run, session="a", tries=3) -> WorkerSettings:
    return WorkerSettings(str(run), session, tries, 600.0, False)


def do_all(run, jobs, session="a"):
    """Do what is not done, in this process, and return the store."""
    root = runs.planned(str(run), jobs)
    for block, done in list(store.blocks(root, jobs)):
        if not done:
            run_block(block, settings(run, session))
    return root
