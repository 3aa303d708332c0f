"""What a command says while it works."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TextIO, TypeVar, cast

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from jaxdeform._apps.mouth import Mouth
from jaxdeform._errors import printable

# Print file names unchanged: brackets are not markup, and lines are not wrapped.
mouth = Mouth()
console = Console(file=cast(TextIO, mouth), highlight=False, markup=False, soft_wrap=True)

Out = TypeVar("Out")


def complain(text: str) -> None:
    """Write a line to standard error. Where nobody takes it, it is lost, and the work goes on."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def patiently(what: str, work: Callable[[], Out]) -> Out:
    """Run work in another thread and show how long it takes."""
    columns = SpinnerColumn(), TextColumn(what, markup=False)
    return _shown(what, None, columns, lambda tell: work())


def counted(what: str, total: int, work: Callable[[Callable[[int, int], None]], Out]) -> Out:
    """Run work in another thread and show how much of it is done, which the work tells."""
    columns = TextColumn(what, markup=False), BarColumn(), MofNCompleteColumn()
    return _shown(what, total, columns, work)


def _shown(
    what: str, total: int | None, columns: tuple[ProgressColumn, ...], work: Callable[..., Out]
) -> Out:
    # While JAX computes, its thread does not receive Ctrl-C; the main thread, which waits, does.
    outcome: Future[Out] = Future()
    with Progress(
        *columns,
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(what, total=total)

        def run() -> None:
            try:
                outcome.set_result(work(lambda done, _: bar.update(task, completed=done)))
            except BaseException as error:
                outcome.set_exception(error)

        threading.Thread(target=run, daemon=True).start()
        return outcome.result()


def say_wrote(*names: Path) -> None:
    console.print(f"wrote {printable(' and '.join(map(str, names)))}")


def since(began: float) -> str:
    return f"{time.perf_counter() - began:.2f} s"
