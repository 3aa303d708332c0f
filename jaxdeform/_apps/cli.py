"""The command line: ``jaxdeform demo | inspect | deform | estimate``."""

import errno
import json
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.table import Table

import jaxdeform as jd
from jaxdeform._apps.arguments import choose_parts, make_folder, read_pose
from jaxdeform._apps.deforming import DeformCommand, deform
from jaxdeform._apps.results import as_json
from jaxdeform._apps.talk import console, mouth, patiently, say_wrote, since
from jaxdeform._errors import printable
from jaxdeform._estimation.held_out import prediction_errors
from jaxdeform._mesh.files import check_output, format_of, without_suffix
from jaxdeform._mesh.writing import check_place, write_atomically
from jaxdeform._plotting import check_picture_path

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
def compute_in_double_precision() -> None:
    """Turn on float64 before a command runs, because files are read and written in float64."""
    jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Run the command line. An InputError becomes a line on standard error and exit code 2."""
    before = signal.signal(signal.SIGINT, _interrupt)
    try:
        try:
            app()
        finally:
            mouth.flush()
    except SystemExit as end:
        if not end.code:
            _tell_failure()
        raise
    except jd.InputError as error:
        print(f"jaxdeform: {error}", file=sys.stderr)
        for note in getattr(error, "__notes__", []):  # where an expression is wrong
            print(note, file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # typer's own texts, such as --help
        if error.errno not in (errno.EPIPE, errno.ENOSPC, errno.EIO):
            raise
        mouth.fail(error)
        _tell_failure()
    except _Interrupted:
        print("jaxdeform: interrupted; no file was left half-written", file=sys.stderr)
        sys.stderr.flush()
        os._exit(130)  # do not wait for the worker thread
    finally:
        signal.signal(signal.SIGINT, before)


def _tell_failure() -> None:
    """Say that the words about the work are lost, unless nobody wanted them."""
    if mouth.failure and mouth.failure.errno != errno.EPIPE:
        reason = mouth.failure.strerror
        print(f"jaxdeform: standard output cannot be written ({reason})", file=sys.stderr)
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
            jd.Result[solution.result],
        )
        poses.append(np.asarray(solution.vertices))
        jd.save_mesh(out / f"{name}.ply", mesh, vertices=poses[-1], rigidity=rigidity)
    console.print(table)
    jd.render(
        out / "demo.png",
        mesh,
        [mesh.vertices, *poses],
        titles=["rest", *materials],
        values=[None, *materials.values()],
    )
    console.print(f"wrote {out / 'demo.png'} and {len(materials)} PLY files")


@app.command()
def inspect(mesh: Annotated[Path, typer.Argument(help="OBJ, OFF, PLY or STL file.")]) -> None:
    """Report what is wrong or unusual with a mesh."""
    console.print(str(jd.inspect(mesh)))


app.command(cls=DeformCommand)(deform)


@app.command()
def estimate(
    rest: Annotated[Path, typer.Argument(help="The undeformed mesh: OBJ, OFF, PLY or STL file.")],
    poses: Annotated[list[Path], typer.Argument(help="Deformed meshes with the same faces.")],
    out: Annotated[Path, typer.Option("--out", "-o", help=".ply file for the rigidity.")],
    handles: Annotated[
        Path | None, typer.Option(help="Handle file. By default, the vertices that moved rigidly.")
    ] = None,
    parts: Annotated[
        Path | None,
        typer.Option(help="The part of each vertex, from 0: one number per line, or .json."),
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EXPR",
            help="Vertices of part 1; given again, of part 2, ... All others are part 0.",
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(
            help="How exactly handles must have moved rigidly to be found, as a fraction of the "
            "bounding box diagonal."
        ),
    ] = 1e-6,
    rings: Annotated[int, typer.Option(min=1, help="Size of the cells, in rings of vertices.")] = 1,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Number of alternating steps. By default, until convergence."),
    ] = None,
    hold_out: Annotated[
        int,
        typer.Option(
            min=0,
            help="Leave out so many poses, the last ones, and report how well they are predicted, "
            "beside ARAP. Found handles are those of all poses.",
        ),
    ] = 0,
) -> None:
    """Estimate the rigidity of a mesh or of its parts from deformed poses."""
    if hold_out >= len(poses):
        raise jd.InputError(
            f"--hold-out {hold_out} leaves none of the {len(poses)} poses to fit: give fewer"
        )
    shape = jd.load_mesh(rest)
    check_output(out)
    report = without_suffix(out).with_suffix(".json")
    if format_of(out) != ".ply":
        raise jd.InputError(f"{out}: only PLY carries rigidity per vertex: use a .ply name")
    check_place(report)
    observed = np.stack([read_pose(path, shape, rest) for path in poses])
    label = choose_parts(parts, part or [], shape)
    if handles is None:
        index = _moved_rigidly(shape, observed, tolerance)
    else:
        index = jd.load_handles(handles, shape).handles
    began = time.perf_counter()
    problem = patiently(
        "precomputing", lambda: jd.precompute(shape, index, cells=jd.rings(shape, rings))
    )
    solver = jd.QuasiNewton() if steps is None else jd.Alternating(steps)
    fitted, kept = np.split(observed, [len(poses) - hold_out])
    fit = patiently(
        "estimating",
        lambda: jd.estimate_rigidity(
            problem, fitted, parts=label, solver=solver, progress=_show_evaluation
        ),
    )
    jd.save_mesh(out, shape, rigidity=fit.field)
    text = json.dumps(as_json(fit, index), indent=1, allow_nan=False)
    write_atomically(report, f"{text}\n".encode())
    console.print(fit.explain())
    console.print(f"estimated in {since(began)}")
    if hold_out:
        _report_held_out(problem, kept, poses[-hold_out:], fit.field)
    say_wrote(out, report)


def _report_held_out(
    problem: jd.Problem, observed: np.ndarray, names: list[Path], field: np.ndarray
) -> None:
    """Predict poses that were not fitted, by the estimate and by ARAP."""
    table = Table("held out", "error, % of the diagonal", "ARAP")
    ours, arap = patiently(
        "predicting",
        lambda: (
            prediction_errors(problem, observed, field, jd.Newton()),
            prediction_errors(problem, observed, 0.0, jd.RotationFit()),
        ),
    )
    for name, mine, rigid in zip(names, ours, arap, strict=True):
        table.add_row(printable(name.name), f"{100 * mine:.3g}", f"{100 * rigid:.3g}")
    console.print(table)


def _moved_rigidly(mesh: jd.Mesh, observed: np.ndarray, tolerance: float) -> np.ndarray:
    groups = jd.find_handle_groups(mesh, observed, tolerance=tolerance)
    sizes = ", ".join(str(len(group.vertices)) for group in groups[:10])
    more = ", ..." if len(groups) > 10 else ""
    console.print(f"handles: {len(groups)} groups of vertices moved rigidly ({sizes}{more})")
    return np.unique(np.concatenate([group.vertices for group in groups]))


def _show_evaluation(evaluation: int, misfit: float, rigidity: np.ndarray) -> None:
    values = ", ".join(f"{value:.3g}" for value in rigidity[:5])
    console.print(f"evaluation {evaluation}: misfit {misfit:.4g}, rigidity {values}")
