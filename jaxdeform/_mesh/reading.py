"""Read the bytes of regular files: a pipe could hang, and a device may never end."""

import json
import re
import stat
import zlib
from pathlib import Path
from typing import Any

from jaxdeform._errors import InputError

_MARK = b"\xef\xbb\xbf"

# Meshes as text become 3 to 30 times smaller. More than this is no mesh, but a file that was made
# to fill the memory.
_MOST_EXPANSION = 200

# What is read behind the end of a member is read again. So each is read in pieces, of which the
# first is small and each twice as long as the one before.
_FIRST_PIECE = 256
_ZEROS = re.compile(rb"\0*")


def read_bytes(path: Path) -> bytes:
    """Return the content of a file, decompressed if its name ends in ``.gz``.

    **Raises** InputError: the file is missing, empty, unreadable, or not a regular file.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
            raise InputError(f"{path}: cannot be read (it is {kind}): give the name of a file")
        # Linux's /proc/kmsg has no size either, and to read it can wait for ever.
        data = path.read_bytes() if status.st_size else b""
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): check the name") from error
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read ({error}): check the name") from error
    if path.suffix.lower() == ".gz":
        data = _decompressed(path, data)
    if not data.strip():
        raise InputError(f"{path}: is empty: export it again")
    return data


def without_mark(data: bytes) -> bytes:
    """Return the content without the byte-order mark that some editors put first."""
    return data.removeprefix(_MARK)


def mark_of(data: bytes) -> bytes:
    """Return the byte-order mark of the content, if it has one."""
    return _MARK if data.startswith(_MARK) else b""


def read_text(path: Path) -> str:
    """Return a text file, without the byte-order mark that some editors put first.

    **Raises** InputError as `read_bytes` does; also if the file is not UTF-8.
    """
    try:
        return without_mark(read_bytes(path)).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not a text file (UTF-8): check the name") from None


def read_json(path: Path) -> Any:
    """Return the content of a JSON file, or raise InputError."""
    text = read_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # not JSON, numbers too long, lists too deep
        raise InputError(f"{path}: is not valid JSON ({error}): correct it there") from error


def _decompressed(path: Path, data: bytes) -> bytes:
    most = _MOST_EXPANSION * len(data) + 1
    out = bytearray()
    at = 0
    try:
        while at < len(data):  # a file may have several members
            member, size = zlib.decompressobj(wbits=31), _FIRST_PIECE
            while not member.eof and at < len(data):
                out += member.decompress(data[at : at + size], most - len(out))
                if len(out) >= most:
                    raise InputError(
                        f"{path}: is more than {_MOST_EXPANSION} times as long when decompressed: "
                        "decompress it yourself if that is right"
                    )
                at, size = at + size, 2 * size
            if not member.eof:
                raise zlib.error("it ends too soon")
            at = min(at, len(data)) - len(member.unused_data)
            zeros = _ZEROS.match(data, at)
            at = zeros.end() if zeros else at
    except zlib.error as error:
        raise InputError(
            f"{path}: cannot be decompressed ({error}): the file is truncated or damaged; copy it "
            "again"
        ) from error
    return bytes(out)
