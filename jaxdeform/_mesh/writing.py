"""Write files. A file on disk is replaced as a whole or not at all."""

import contextlib
import os
import secrets
import stat
from pathlib import Path

from jaxdeform._errors import InputError

try:
    import fcntl
except ImportError:  # Windows, where an open file cannot be removed
    fcntl = None

_PREFIX = ".jaxdeform-writing-"


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under another name in the same folder, then rename it to ``path``.

    The content is on the disk before the rename. The old file's permissions stay; a symbolic link
    stays a link, and the file that it names is replaced. What a killed process left of its writing
    in that folder is removed.

    **Raises** InputError if the file or the folder cannot be written. An old file is then kept.
    """
    check_place(path)
    target = Path(os.path.realpath(path))
    _remove_abandoned(target.parent)
    try:
        old = target.stat() if target.exists() else None
        name, handle = _locked(target.parent, 0o666 if old is None else 0o600)
    except OSError as error:
        raise _unwritable(path, error, "check the folder") from error
    try:
        with os.fdopen(handle, "wb") as file:
            if old is not None:
                _copy_owner_and_mode(old, name)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            if fcntl:  # the lock holds until the file is no longer a temporary one
                os.replace(name, target)
        if not fcntl:
            os.replace(name, target)
    except OSError as error:
        raise _unwritable(path, error, "choose another name") from error
    finally:
        name.unlink(missing_ok=True)
    _sync_folder(target.parent)


def check_place(path: Path) -> None:
    """Raise InputError if no file can be written at this path."""
    old = None
    try:
        target = Path(os.path.realpath(path))
        with contextlib.suppress(FileNotFoundError):
            old = target.stat()
    except (OSError, ValueError) as error:
        raise _unwritable(path, error, "choose another name") from error
    if target.is_dir():
        raise InputError(f"{path}: is a folder: give the name of a file")
    if not target.parent.is_dir():
        raise InputError(f"{path}: cannot write there: make the folder {target.parent} first")
    if old is not None and not stat.S_ISREG(old.st_mode):
        raise InputError(f"{path}: is a pipe or a device: give the name of a file")
    # To the administrator access() allows all, but who made a file read-only meant it.
    if old is not None and not (old.st_mode & 0o222 and os.access(target, os.W_OK)):
        raise InputError(f"{path}: is read-only: make it writeable, or choose another name")
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"{path}: the folder {target.parent} cannot be written: choose another")


def _unwritable(path: Path, error: Exception, move: str) -> InputError:
    reason = getattr(error, "strerror", None) or error
    return InputError(f"{path}: cannot write there ({reason}): {move}")


def _locked(folder: Path, mode: int) -> tuple[Path, int]:
    """Make a new file and lock it, so that other processes see that its writer lives.

    The system takes the mask of the process from the mode. (To ask for the mask, one would have to
    set it, for all threads.)
    """
    while True:
        name = folder / f"{_PREFIX}{secrets.token_hex(8)}"
        flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)
        handle = os.open(name, flags, mode)
        if fcntl:
            with contextlib.suppress(OSError):  # some network disks know no locks
                fcntl.flock(handle, fcntl.LOCK_EX)
        # Another process may have taken it for abandoned before it was locked.
        if name.exists():
            return name, handle
        os.close(handle)


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files that no living process has locked."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(_PREFIX) and entry.is_file(follow_symlinks=False):
                with contextlib.suppress(OSError):
                    _remove_if_abandoned(entry.path)


def _remove_if_abandoned(name: str) -> None:
    if not fcntl:
        os.unlink(name)
        return
    handle = os.open(name, os.O_RDONLY | os.O_NONBLOCK)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.unlink(name)
    finally:
        os.close(handle)


def _copy_owner_and_mode(old: os.stat_result, name: Path) -> None:
    if hasattr(os, "chown"):
        with contextlib.suppress(OSError):  # only the administrator may give files away
            os.chown(name, old.st_uid, old.st_gid)
    os.chmod(name, stat.S_IMODE(old.st_mode))


def _sync_folder(folder: Path) -> None:
    """Bring the rename itself to the disk, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
