"""The command line: ``jaxdeform demo | inspect | deform | estimate | batch``."""

import contextlib
import errno
import os
import signal
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer
from rich.table import Table

import jaxdeform as jd
from jaxdeform._apps.arguments import make_folder
from jaxdeform._apps.batch.command import batch
from jaxdeform._apps.deforming import DeformCommand, deform
from jaxdeform._apps.estimating import estimate
from jaxdeform._apps.mouth import open_closed_outputs
from jaxdeform._apps.talk import complain, console, mouth, patiently, since
from jaxdeform._errors import printable
from jaxdeform._plotting.files import check_picture_path

app = typer.Typer(
    help="Deform triangle meshes whose parts differ in rigidity.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


class _Interrupted(BaseException):
    """Ctrl-C. (Typer would handle a KeyboardInterrupt itself.)"""


def _interrupt(*_) -> None:
    raise _Interrupted


@app.callback()
def set_up(
    cache: Annotated[
        bool,
        typer.Option(
            "--cache/--no-cache",
            help="Keep compiled programs for the next run, in the user's cache folder or in that "
            "of JAXDEFORM_CACHE_DIR.",
        ),
    ] = True,
) -> None:
    """Set up the process before a command runs."""
    jax.config.update("jax_enable_x64", True)  # files are read and written in float64
    if cache:
        # Without a folder, or with a damaged one, programs are compiled as if there were none.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
        with contextlib.suppress(jd.InputError):
            jd.enable_compilation_cache()


def main() -> None:
    """Run the command line. An InputError becomes a line on standard error and exit code 2."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)  # what is lost is told in any case
        warnings.showwarning = _complain_of
        _run()


def _complain_of(message: Warning | str, *_: Any) -> None:
    """Tell of a warning as the command tells of all else, without the line of Python it is from."""
    complain(f"jaxdeform: {printable(str(message))}")


def _run() -> None:
    open_closed_outputs()
    before = signal.signal(signal.SIGINT, _interrupt)
    try:
        try:
            app(_with_cache_first(sys.argv[1:]))
        finally:
            mouth.flush()
    except SystemExit as end:
        if not end.code:
            _tell_failure()
        raise
    except jd.InputError as error:
        complain(f"jaxdeform: {error}")
        for note in getattr(error, "__notes__", []):  # where an expression is wrong
            complain(note)
        sys.exit(2)
    except OSError:
        # Typer writes its own texts, such as --help, to standard output, which then fails again.
        mouth.write("\n")
        mouth.flush()
        if mouth.failure is None:
            raise
        _tell_failure()
    except _Interrupted:
        complain("jaxdeform: interrupted; no file was left half-written")
        os._exit(130)  # do not wait for the worker thread
    finally:
        signal.signal(signal.SIGINT, before)


def _with_cache_first(words: list[str]) -> list[str]:
    """Return the arguments; ``--no-cache``, which every command takes, before the command."""
    return sorted(words, key=lambda word: word not in ("--cache", "--no-cache"))


def _tell_failure() -> None:
    """Say that the words about the work are lost, unless nobody wanted them."""
    if mouth.failure and mouth.failure.errno != errno.EPIPE:
        reason = mouth.failure.strerror
        complain(f"jaxdeform: standard output cannot be written ({reason})")
        sys.exit(1)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("out"),
) -> None:
    """Bend a bar of soft, stiff and mixed material; write the deformed meshes and a picture."""
    make_folder(out)
    check_picture_path(out / "demo.png")
    mesh = jd.shapes.bar()
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 6) | (y > 145))
    began = time.perf_counter()
    problem = jd.precompute(mesh, handles)
    console.print(f"{mesh}, {len(handles)} handles: precomputed in {since(began)}")
    targets = jd.bend(mesh.vertices[handles], 90.0)
    materials = {
        "soft": np.full(mesh.n_vertices, 0.01),
        "stiff": np.full(mesh.n_vertices, 30.0),
        "soft-below-stiff": np.where(y < y.mean(), 0.01, 30.0),
    }
    table = Table("material", "energy", "steps", "seconds", "result")
    poses = []
    for name, rigidity in materials.items():
        began = time.perf_counter()
        bend = partial(jd.deform, problem, targets, rigidity)
        solution = patiently(f"bending the {name} bar", bend)
        table.add_row(
            name,
            f"{float(solution.energy[-1]):.4g}",
            str(int(solution.steps)),
            since(began),
            solution.explain(),
        )
        poses.append(np.asarray(solution.vertices))
        jd.save_mesh(out / f"{name}.ply", mesh, vertices=poses[-1], rigidity=rigidity)
    console.print(table)
    jd.render(
        out / "demo.png",
        mesh,
        [mesh.vertices, *poses],
        titles=["rest", *(name.replace("-", " ") for name in materials)],
        values=[None, *materials.values()],
        handles=handles,
    )
    console.print(f"wrote {out / 'demo.png'} and {len(materials)} PLY files")


@app.command()
def inspect(mesh: Annotated[Path, typer.Argument(help="OBJ, OFF, PLY or STL file.")]) -> None:
    """Report what is wrong or unusual with a mesh."""
    console.print(str(jd.inspect(mesh)))


app.command(cls=DeformCommand)(deform)


app.command()(estimate)


app.command()(batch)
