"""Keep compiled programs on disk, so that the next process need not compile them."""

import hashlib
import os
import platform
import zlib
from importlib.metadata import version
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

from jaxdeform._errors import InputError

MOST_BYTES = 2**29
"""About 500 programs."""
_MOVED = "JAXDEFORM_CACHE_DIR"
_CHECKED = ".checked"


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keep what JAX compiles from now on, and use what earlier processes have kept.

    The library does not do it by itself, because it is a setting of the whole process. The command
    line does. A first deformation of a mesh with 4,802 vertices then takes 4.7 instead of 12.4 s
    (two cores of a slow machine, the mesh seen by an earlier process); what is left is tracing.

    The programs of another jaxlib or another processor are kept apart. Processes may share the
    folder. At most 512 MiB stay in it: those that were not used for longest go first, whenever this
    is called. Damaged files are removed.

    **Arguments**

    - folder: where to keep it. By default the environment variable ``JAXDEFORM_CACHE_DIR``, or the
      user's own cache folder (``~/.cache/jaxdeform`` on Linux). Where JAX has a folder already
      (``JAX_COMPILATION_CACHE_DIR``), that one stays unless one is given here.

    **Returns** the folder in use.

    **Raises** InputError if the folder cannot be made or written.

    Example:
        >>> import jaxdeform as jd
        >>> jd.enable_compilation_cache().is_absolute()
        True
    """
    known = jax.config.values.get("jax_compilation_cache_dir")
    if folder is None and known:
        return Path(known).absolute()
    base = folder or os.environ.get(_MOVED) or platformdirs.user_cache_dir("jaxdeform", False)
    try:
        place = Path(base).expanduser().absolute() / _kind_of_machine()
        place.mkdir(parents=True, exist_ok=True)
        _clean(place)
    except (OSError, TypeError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"{base}: cannot keep compiled programs there ({reason}): give another folder, or set "
            f"{_MOVED}"
        ) from error
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    compilation_cache.reset_cache()  # it may have begun, without a folder
    return place


def _kind_of_machine() -> str:
    """Name what a program was compiled for: one made for another processor may not run here."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        abilities = sorted({line for line in lines if line.startswith(("flags", "Features"))})
    except OSError:
        abilities = [platform.processor()]
    what = [platform.system(), platform.machine(), *abilities]
    return f"{version('jaxlib')}-{hashlib.sha256(repr(what).encode()).hexdigest()[:12]}"


def _clean(folder: Path) -> None:
    """Remove damaged entries, each looked at once, and the oldest ones beyond the size allowed.

    JAX would read a damaged entry in vain in every process, and never replace it.
    """
    stamp = folder / _CHECKED
    since = stamp.stat().st_mtime_ns if stamp.exists() else 0
    stamp.touch()  # first: what is written meanwhile will be looked at next time
    kept = []
    for entry in os.scandir(folder):
        if not entry.name.endswith("-cache"):
            continue
        try:
            state = entry.stat()
            if state.st_mtime_ns >= since and _is_damaged(Path(entry.path)):
                os.unlink(entry.path)
            else:
                kept.append((max(state.st_atime, state.st_mtime), state.st_size, entry.path))
        except FileNotFoundError:  # another process removed it
            continue
    total = sum(size for _, size, _ in kept)
    for _, size, path in sorted(kept):
        if total <= MOST_BYTES:
            break
        Path(path).unlink(missing_ok=True)
        total -= size


def _is_damaged(path: Path) -> bool:
    """Whether an entry is incomplete or its sum is wrong. (One that zstandard packed is taken.)"""
    content = path.read_bytes()
    if content.startswith(b"\x28\xb5\x2f\xfd"):
        return False
    try:
        unpacked = zlib.decompressobj()
        unpacked.decompress(content)
        return not unpacked.eof
    except zlib.error:
        return True
