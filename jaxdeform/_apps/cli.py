"""The command line: ``jaxdeform demo | inspect | deform | estimate``."""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

import jax
import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

import jaxdeform as jd
from jaxdeform._checks import check_rigidity
from jaxdeform._estimation.parts import check_parts
from jaxdeform._mesh.files import check_output
from jaxdeform._mesh.writing import check_place, write_atomically
from jaxdeform._plotting import check_picture_path

app = typer.Typer(
    help="Deform triangle meshes whose parts differ in rigidity.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
# Print file names unchanged: brackets are not markup, and lines are not wrapped.
console = Console(highlight=False, markup=False, soft_wrap=True)

Out = TypeVar("Out")


class _Interrupted(BaseException):
    """Ctrl-C. (Typer would handle a KeyboardInterrupt itself.)"""


def _interrupt(*_) -> None:
    raise _Interrupted


@app.callback()
def compute_in_double_precision() -> None:
    """Turn on float64 before a command runs, because files are read and written in float64."""
    jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Run the command line. An InputError becomes one line on standard error and exit code 2."""
    before = signal.signal(signal.SIGINT, _interrupt)
    try:
        app()
    except jd.InputError as error:
        print(f"jaxdeform: {error}", file=sys.stderr)
        sys.exit(2)
    except _Interrupted:
        print("jaxdeform: interrupted; no file was left half-written", file=sys.stderr)
        sys.stderr.flush()
        os._exit(130)  # do not wait for the worker thread
    finally:
        signal.signal(signal.SIGINT, before)


def _patiently(what: str, work: Callable[[], Out]) -> Out:
    """Run work in another thread and show how long it takes.

    While JAX computes, its thread does not receive Ctrl-C; the main thread, which waits, does.
    """
    outcome: Future[Out] = Future()

    def run() -> None:
        try:
            outcome.set_result(work())
        except BaseException as error:
            outcome.set_exception(error)

    columns = SpinnerColumn(), TextColumn(what, markup=False), TimeElapsedColumn()
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        bar.add_task(what, total=None)
        threading.Thread(target=run, daemon=True).start()
        return outcome.result()


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("out"),
) -> None:
    """Bend a bar of soft, stiff and mixed material; write the deformed meshes and a picture."""
    _make_folder(out)
    check_picture_path(out / "demo.png")
    mesh = jd.shapes.bar()
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 6) | (y > 145))
    began = time.perf_counter()
    problem = jd.precompute(mesh, handles)
    console.print(f"{mesh}, {len(handles)} handles: precomputed in {_since(began)}")
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
        solution = _patiently(f"bending the {name} bar", bend)
        table.add_row(
            name,
            f"{float(solution.energy[-1]):.4g}",
            str(int(solution.steps)),
            _since(began),
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


@app.command()
def deform(
    mesh: Annotated[Path, typer.Argument(help="OBJ, OFF, PLY or STL file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Mesh file to write.")],
    handles: Annotated[
        Path, typer.Option(help="Handle file: .json, or .sel with a .def of the same name.")
    ],
    rigidity: Annotated[
        str, typer.Option(help="A number, or a PLY file with one rigidity per vertex.")
    ],
    rings: Annotated[int, typer.Option(min=1, help="Size of the cells, in rings of vertices.")] = 1,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of alternating steps. By default, until convergence (100 with --normals).",
        ),
    ] = None,
    normals: Annotated[bool, typer.Option(help="Add the normal term (Eq. 4.7).")] = False,
    motion: Annotated[
        Path | None, typer.Option(help="The .def file of a .sel handle file.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG file for a picture of both shapes.")
    ] = None,
) -> None:
    """Move the handles of a mesh; the rest of it follows."""
    shape = jd.load_mesh(mesh)
    # Check all arguments before the long work.
    check_output(out)
    if picture is not None:
        check_picture_path(picture)
    moves = jd.load_handles(handles, shape, motion)
    values = _rigidity(rigidity, shape)
    began = time.perf_counter()
    problem = _patiently(
        "precomputing", lambda: jd.precompute(shape, moves.handles, cells=jd.rings(shape, rings))
    )
    console.print(f"{shape}, {len(moves.handles)} handles: precomputed in {_since(began)}")
    began = time.perf_counter()
    solver = None if steps is None else jd.Alternating(steps)
    solution = _patiently(
        "deforming",
        lambda: jd.deform(problem, moves.targets, values, solver=solver, normals=normals),
    )
    energy, done = float(solution.energy[-1]), int(solution.steps)
    console.print(f"energy {energy:.6g} after {done} steps in {_since(began)}")
    console.print(jd.Result[solution.result])
    color = values if out.suffix.lower() == ".ply" else None
    jd.save_mesh(out, shape, vertices=np.asarray(solution.vertices), rigidity=color)
    console.print(f"wrote {out}")
    if picture is not None:
        poses = [shape.vertices, np.asarray(solution.vertices)]
        colors = [None, values] if values.ndim else []
        jd.render(picture, shape, poses, titles=["rest", "deformed"], values=colors)
        console.print(f"wrote {picture}")


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
) -> None:
    """Estimate the rigidity of a mesh or of its parts from deformed poses."""
    shape = jd.load_mesh(rest)
    check_output(out)
    report = out.with_suffix(".json")
    if out.suffix.lower() != ".ply":
        raise jd.InputError(f"{out}: only PLY carries rigidity per vertex: use a .ply name")
    check_place(report)
    observed = np.stack([_pose(path, shape, rest) for path in poses])
    label = np.zeros(shape.n_vertices, int) if parts is None else _parts(parts, shape)
    if handles is None:
        index = _moved_rigidly(shape, observed, tolerance)
    else:
        index = jd.load_handles(handles, shape).handles
    began = time.perf_counter()
    problem = _patiently(
        "precomputing", lambda: jd.precompute(shape, index, cells=jd.rings(shape, rings))
    )
    solver = jd.QuasiNewton() if steps is None else jd.Alternating(steps)
    fit = _patiently(
        "estimating",
        lambda: jd.estimate_rigidity(
            problem, observed, parts=label, solver=solver, progress=_show_evaluation
        ),
    )
    console.print(_part_table(fit, label))
    console.print(f"misfit {fit.misfit:.4g} after {len(fit.history)} evaluations, {_since(began)}")
    console.print(jd.Result[fit.result])
    jd.save_mesh(out, shape, rigidity=fit.field)
    text = json.dumps(_as_json(fit, index), indent=1, allow_nan=False)
    write_atomically(report, f"{text}\n".encode())
    console.print(f"wrote {out} and {report}")


def _moved_rigidly(mesh: jd.Mesh, observed: np.ndarray, tolerance: float) -> np.ndarray:
    groups = jd.find_handle_groups(mesh, observed, tolerance=tolerance)
    sizes = ", ".join(str(len(group.vertices)) for group in groups[:10])
    more = ", ..." if len(groups) > 10 else ""
    console.print(f"handles: {len(groups)} groups of vertices moved rigidly ({sizes}{more})")
    return np.unique(np.concatenate([group.vertices for group in groups]))


def _show_evaluation(evaluation: int, misfit: float, rigidity: np.ndarray) -> None:
    values = ", ".join(f"{value:.3g}" for value in rigidity[:5])
    console.print(f"evaluation {evaluation}: misfit {misfit:.4g}, rigidity {values}")


def _part_table(fit: jd.Estimate, label: np.ndarray) -> Table:
    table = Table("part", "vertices", "rigidity", "95 % interval", "verdict")
    for k, (value, (low, high)) in enumerate(zip(fit.rigidity, fit.interval, strict=True)):
        size = str(int((label == k).sum()))
        table.add_row(str(k), size, f"{value:.4g}", f"{low:.4g} to {high:.4g}", fit.verdict[k])
    return table


def _pose(path: Path, rest: jd.Mesh, name: Path) -> np.ndarray:
    pose = jd.load_mesh(path)
    if pose.n_vertices != rest.n_vertices or not np.array_equal(pose.faces, rest.faces):
        raise jd.InputError(
            f"{path}: is not a pose of {name}: {pose} and {rest} must have the same vertices and "
            "faces, in the same order"
        )
    return pose.vertices


def _parts(path: Path, mesh: jd.Mesh) -> np.ndarray:
    try:
        text = path.read_text(encoding="utf-8")
        values = json.loads(text) if path.suffix.lower() == ".json" else text.split()
        label = np.array([int(value) for value in values])
    except (OSError, ValueError, TypeError) as error:
        raise jd.InputError(
            f"{path}: cannot be read as one integer per vertex ({error}): give a number per line"
        ) from error
    try:
        return check_parts(label, mesh.n_vertices)
    except jd.InputError as error:
        raise jd.InputError(f"{path}: {error}") from error


def _as_json(fit: jd.Estimate, handles: np.ndarray) -> dict:
    """Return the content of the report. JSON has no infinity, so null stands for it."""
    finite = lambda value: float(value) if np.isfinite(value) else None  # noqa: E731
    return {
        "parts": [
            {"rigidity": float(value), "interval": list(map(finite, pair)), "verdict": verdict}
            for value, pair, verdict in zip(fit.rigidity, fit.interval, fit.verdict, strict=True)
        ],
        "misfit": finite(fit.misfit),
        "history": list(map(finite, fit.history)),
        "result": {"ok": fit.ok, "sentence": jd.Result[fit.result]},
        "handles": handles.tolist(),
    }


def _rigidity(text: str, mesh: jd.Mesh) -> np.ndarray:
    try:
        values = np.asarray(float(text))
    except ValueError:
        if not Path(text).exists():
            raise jd.InputError(
                f"--rigidity {text}: is neither a number nor a file: give a number or a PLY file"
            ) from None
        values = jd.load_rigidity(text)
    try:
        check_rigidity(values, mesh.n_vertices, values.dtype)
    except jd.InputError as error:
        raise jd.InputError(f"--rigidity {text}: {error}") from error
    return values


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise jd.InputError(
            f"{folder}: cannot be made ({error.strerror}): choose another folder"
        ) from error


def _since(began: float) -> str:
    return f"{time.perf_counter() - began:.2f} s"
