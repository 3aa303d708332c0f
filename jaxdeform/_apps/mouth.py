"""Standard output that may close or fill up while a command runs."""

import io
import os
import sys


def open_closed_outputs() -> None:
    """Send standard output and standard error nowhere where the caller closed them (``>&-``).

    Python has None for them then. A file that is opened later would get their number, and with it
    what libraries print.
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is not None:
            continue
        nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 (as long as the process)
        try:
            os.fstat(number)
        except OSError:
            os.dup2(nowhere.fileno(), number)
        setattr(sys, name, nowhere)


class Mouth:
    """Writes to standard output until that fails; from then on it is silent.

    Who reads the output may leave early (``| head``), and a disk may be full. Neither may end the
    work that the output only tells of.
    """

    failure: OSError | None = None
    """What went wrong, if anything did."""

    def write(self, text: str) -> int:
        """Write the text; show as escapes what the terminal has no signs for."""
        encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
        try:
            sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except OSError as error:
            self.fail(error)
        return len(text)

    def flush(self) -> None:
        """Flush standard output."""
        try:
            sys.stdout.flush()
        except OSError as error:
            self.fail(error)

    def fail(self, error: OSError) -> None:
        """Send the rest of standard output nowhere, also what Python flushes at its end."""
        self.failure = error
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
        except (OSError, io.UnsupportedOperation):
            sys.stdout = io.StringIO()

    def __getattr__(self, name: str):
        """Return what standard output says, such as whether it is a terminal."""
        return getattr(sys.stdout, name)
