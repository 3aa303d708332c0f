"""The command ``jaxdeform deform``."""

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import jaxdeform as jd
from jaxdeform._apps.arguments import read_rigidity
from jaxdeform._apps.results import save_result
from jaxdeform._apps.talk import console, patiently, say_wrote, since
from jaxdeform._mesh.files import check_output, format_of
from jaxdeform._plotting import check_picture_path


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
    check_output(out, shape)
    if picture is not None:
        check_picture_path(picture)
    moves = jd.load_handles(handles, shape, motion)
    values = read_rigidity(rigidity, shape)
    began = time.perf_counter()
    problem = patiently(
        "precomputing", lambda: jd.precompute(shape, moves.handles, cells=jd.rings(shape, rings))
    )
    console.print(f"{shape}, {len(moves.handles)} handles: precomputed in {since(began)}")
    began = time.perf_counter()
    solver = None if steps is None else jd.Alternating(steps)
    solution = patiently(
        "deforming",
        lambda: jd.deform(problem, moves.targets, values, solver=solver, normals=normals),
    )
    # The result first, then words about it: whatever happens to those, the work is kept.
    color = values if format_of(out) == ".ply" else None
    save_result(out, shape, np.asarray(solution.vertices), color)
    energy, done = float(solution.energy[-1]), int(solution.steps)
    console.print(f"energy {energy:.6g} after {done} steps in {since(began)}")
    console.print(jd.Result[solution.result])
    say_wrote(out)
    if picture is not None:
        poses = [shape.vertices, np.asarray(solution.vertices)]
        colors = [None, values] if values.ndim else []
        jd.render(picture, shape, poses, titles=["rest", "deformed"], values=colors)
        say_wrote(picture)
