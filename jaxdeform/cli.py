"""The command line: ``jaxdeform demo | inspect | deform``."""

import sys
import time
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

# Files are read and written in double precision, so the command line computes in it.
jax.config.update("jax_enable_x64", True)

import jaxdeform as jd  # noqa: E402 (after x64)

app = typer.Typer(
    help="Deform triangle meshes whose parts differ in rigidity.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console(stderr=False, highlight=False)

# Steps between two moves of the progress bar: T is a function of the positions alone, so an
# iteration may be cut anywhere and gone on with.
_CHUNK = 10


def main() -> None:
    """Run the command line; an InputError is one line on standard error, and exit code 2."""
    try:
        app()
    except jd.InputError as error:
        print(f"jaxdeform: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("jaxdeform: interrupted; files that were there are whole", file=sys.stderr)
        sys.exit(130)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("out"),
) -> None:
    """Bend a bar of two materials and write the deformed meshes and a picture."""
    _make_folder(out)
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
        with console.status(f"bending the {name} bar"):
            solution = jd.deform(problem, targets, rigidity)
        table.add_row(
            name,
            f"{float(solution.energy[-1]):.4g}",
            str(int(solution.steps)),
            _since(began),
            str(solution.result),
        )
        poses.append(np.asarray(solution.vertices))
        jd.save_mesh(out / f"{name}.ply", mesh, vertices=poses[-1], rigidity=rigidity)
    console.print(table)
    jd.picture(
        out / "demo.png",
        mesh,
        [mesh.vertices, *poses],
        titles=["rest", *materials],
        values=[None, *materials.values()],
    )
    console.print(f"wrote {out / 'demo.png'} and {len(materials)} PLY files")


@app.command()
def inspect(mesh: Annotated[Path, typer.Argument(help="OBJ, OFF, PLY or STL file.")]) -> None:
    """Say what is wrong or unusual with a mesh."""
    console.print(str(jd.inspect(mesh)))


@app.command()
def deform(
    mesh: Annotated[Path, typer.Argument(help="OBJ, OFF, PLY or STL file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write the result to.")],
    handles: Annotated[Path, typer.Option(help="Handle file: .json, or .sel beside a .def.")],
    rigidity: Annotated[
        str, typer.Option(help="A number, or a PLY file with a rigidity per vertex.")
    ],
    rings: Annotated[int, typer.Option(help="Size of the neighbourhoods.")] = 1,
    steps: Annotated[
        int | None, typer.Option(help="This many alternating steps; to convergence if left out.")
    ] = None,
    normals: Annotated[bool, typer.Option(help="Add the normal term (Eq. 4.7).")] = False,
    motion: Annotated[Path | None, typer.Option(help=".def file of a .sel handle file.")] = None,
    picture: Annotated[Path | None, typer.Option(help="PNG of the rest and the result.")] = None,
) -> None:
    """Move the handles of a mesh and let the rest follow."""
    shape = jd.load_mesh(mesh)
    # Whatever can be wrong is found before the long work.
    jd.check_output(out)
    held = jd.load_handles(handles, shape, motion)
    values = _rigidity(rigidity)
    began = time.perf_counter()
    with console.status("precomputing"):
        problem = jd.precompute(shape, held.handles, cells=jd.rings(shape, rings))
    console.print(f"{shape}, {len(held.handles)} handles: precomputed in {_since(began)}")
    began = time.perf_counter()
    if normals and steps is None:
        steps = 100
    if steps is None:
        with console.status("deforming"):
            solution = jd.deform(problem, held.targets, values)
    else:
        solution = _alternate(problem, held.targets, values, steps, normals)
    done = int(solution.steps) if steps is None else steps
    console.print(f"energy {float(solution.energy[-1]):.6g} after {done} steps in {_since(began)}")
    console.print(str(solution.result))
    color = values if out.suffix.lower() == ".ply" else None
    jd.save_mesh(out, shape, vertices=np.asarray(solution.vertices), rigidity=color)
    console.print(f"wrote {out}")
    if picture is not None:
        poses = [shape.vertices, np.asarray(solution.vertices)]
        jd.picture(picture, shape, poses, titles=["rest", "deformed"])
        console.print(f"wrote {picture}")


def _alternate(problem, targets, rigidity, steps: int, normals: bool) -> jd.Solution:
    if steps < 1:
        raise jd.InputError(f"--steps {steps}: give 1 or more")
    start, solution = None, None
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("deforming", total=steps)
        for done in range(0, steps, _CHUNK):
            chunk = jd.Alternating(steps=min(_CHUNK, steps - done))
            solution = jd.deform(
                problem, targets, rigidity, solver=chunk, start=start, normals=normals
            )
            start = solution.vertices
            progress.update(task, completed=done + chunk.steps)
    assert solution is not None
    return solution


def _rigidity(text: str) -> np.ndarray:
    try:
        return np.asarray(float(text))
    except ValueError:
        pass
    if not Path(text).exists():
        raise jd.InputError(f"--rigidity {text}: is neither a number nor a PLY file")
    return jd.load_rigidity(text)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise jd.InputError(f"{folder}: cannot be made ({error.strerror})") from error


def _since(began: float) -> str:
    return f"{time.perf_counter() - began:.2f} s"
