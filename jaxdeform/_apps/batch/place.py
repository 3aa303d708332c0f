"""The place of a run: a folder, which one command holds at a time, or an address of fsspec."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jaxdeform as jd
from jaxdeform._apps.arguments import make_folder
from jaxdeform._apps.batch.store import FOLDER

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = ".jaxdeform-batch-lock"


def is_address(run: str) -> bool:
    return "://" in run


def check_address(run: str) -> None:
    """Raise InputError if this is an address that cannot be reached."""
    if run.startswith("memory://"):
        raise jd.InputError(
            f"{run}: the workers are other processes, with other memory: give a folder"
        )
    if is_address(run):
        import fsspec.core

        try:
            fsspec.core.url_to_fs(run)
        except Exception as error:  # each protocol has its own
            raise jd.InputError(
                f"{run}: cannot be reached ({error}): check the address, or install what it needs"
            ) from error


@contextmanager
def alone(run: str) -> Iterator[None]:
    """Hold the folder of a run, so that no other command works on it.

    The system frees it when this process ends, however it ends. An address cannot be held.

    **Raises** InputError where another command holds it, where it cannot be made or written, or
    where it has other files in it.
    """
    if is_address(run):
        yield
        return
    make_folder(Path(run))
    try:
        found = set(os.listdir(run))
        if found and not found & {LOCK, FOLDER}:
            raise other_files(run)
        handle = os.open(Path(run, LOCK), os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise jd.InputError(
            f"{run}: cannot be written ({error.strerror}): choose another folder"
        ) from error
    try:
        if fcntl:
            _lock(run, handle)
        yield
    finally:
        os.close(handle)


def _lock(run: str, handle: int) -> None:
    assert fcntl
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise jd.InputError(
            f"{run}: another command works on this run: wait for its end (jaxdeform batch --status "
            "says how far it is)"
        ) from None
    except OSError:  # some network disks know no locks
        return


def other_files(run: str) -> jd.InputError:
    return jd.InputError(f"{run}: is a folder with other files in it: choose a new name")


@contextmanager
def readable(run: str) -> Iterator[None]:
    """Raise InputError for whatever Zarr, fsspec and the disk raise at the store of a run."""
    try:
        yield
    except jd.InputError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise jd.InputError(
            f"{run}: its store cannot be read or written ({reason}): repair that and run the same "
            "command again, or give another folder"
        ) from error
