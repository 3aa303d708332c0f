"""The command ``jaxdeform estimate``."""

import json
import time
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.table import Table

import jaxdeform as jd
from jaxdeform._apps.arguments import choose_parts, read_pose
from jaxdeform._apps.results import as_json, save_result
from jaxdeform._apps.talk import console, patiently, say_wrote, since
from jaxdeform._errors import number_of, printable
from jaxdeform._estimation.found_handles import FoundHandles, search_handles
from jaxdeform._estimation.held_out import prediction_errors
from jaxdeform._mesh.files import check_output, format_of, without_suffix
from jaxdeform._mesh.writing import check_place, write_atomically
from jaxdeform._plotting.files import check_picture_path

_HoldOut = Annotated[
    int,
    typer.Option(
        min=0,
        help="Leave out so many poses, the last ones, and report how well they are predicted, "
        "beside ARAP. Found handles are those of all poses.",
    ),
]
_Tolerance = Annotated[
    float | None,
    typer.Option(
        help="How exactly handles must have moved rigidly to be found, as a fraction of the "
        "bounding box diagonal. By default four times the noise that is found."
    ),
]
_MostRings = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=20,
        help="Estimate the size of the cells too, for each part from 1 to so many rings, by the "
        "misfit.",
    ),
]
_PictureFile = Annotated[
    Path | None,
    typer.Option(
        help="PNG file for a picture of all shapes with the handles marked, before the search "
        "begins; after it the rigidity is the colour."
    ),
]


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
    tolerance: _Tolerance = None,
    rings: Annotated[int, typer.Option(min=1, help="Size of the cells, in rings of vertices.")] = 1,
    most_rings: _MostRings = None,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Number of alternating steps. By default, until convergence."),
    ] = None,
    hold_out: _HoldOut = 0,
    picture: _PictureFile = None,
) -> None:
    """Estimate the rigidity of a mesh or of its parts from deformed poses."""
    _check_hold_out(hold_out, len(poses))
    if handles and tolerance is not None:
        raise jd.InputError("--tolerance is for handles that are to be found: leave out --handles")
    if most_rings and (rings != 1 or steps):
        raise jd.InputError("--most-rings goes with neither --rings nor --steps: leave these out")
    if picture is not None:
        check_picture_path(picture)
    shape = jd.load_mesh(rest)
    report = _check_names(out)
    observed = np.stack([read_pose(path, shape, rest) for path in poses])
    label = choose_parts(parts, part or [], shape)
    index, found = _handles(handles, shape, observed, tolerance)
    draw = _Picture(picture, shape, [rest, *poses], observed, index).draw
    draw()
    began = time.perf_counter()
    cells = jd.rings(shape, rings)
    problem = patiently("precomputing", lambda: jd.precompute(shape, index, cells=cells))
    fitted, kept = np.split(observed, [len(poses) - hold_out])
    problem, fit, sizes = _fit(problem, fitted, label, steps, most_rings)
    failed = _saved(out, report, shape, fit, as_json(fit, index, found, sizes))
    console.print(f"{fit.explain()}\nestimated in {since(began)}")
    if hold_out:
        _report_held_out(problem, kept, poses[-hold_out:], fit.field)
    if failed:
        raise failed
    say_wrote(out, report)
    draw(fit.field)


class _Picture(NamedTuple):
    """All shapes beside each other with the handles marked, if a file is named for them."""

    path: Path | None
    shape: jd.Mesh
    names: list[Path]
    observed: np.ndarray
    handles: np.ndarray

    def draw(self, rigidity: np.ndarray | None = None) -> None:
        if self.path is None:
            return
        jd.render(
            self.path,
            self.shape,
            [self.shape.vertices, *self.observed],
            titles=[printable(name.name) for name in self.names],
            values=[] if rigidity is None else [rigidity] * len(self.names),
            handles=self.handles,
        )
        say_wrote(self.path)


def _saved(
    out: Path, report: Path, shape: jd.Mesh, fit: jd.Estimate, content: dict[str, Any]
) -> jd.InputError | None:
    """Write the field and the report; return why one could not be written.

    A failure of one does not stop the other. A report without a file is printed.
    """
    failed = None
    try:
        save_result(out, shape, None, fit.field)
    except jd.InputError as error:
        failed = error
    text = f"{json.dumps(content, indent=1, allow_nan=False)}\n".encode()
    try:
        write_atomically(report, text)
    except jd.InputError as error:
        failed = failed or error
        console.print(text.decode(), end="")
    return failed


def _fit(
    problem: jd.Problem, observed, label: np.ndarray, steps: int | None, most_rings: int | None
) -> tuple[jd.Problem, jd.Estimate, list[int] | None]:
    """Return the problem that was fitted, the fit, and the sizes of the cells if estimated."""
    if most_rings:
        return _fit_rings(problem, observed, label, most_rings)
    solver = jd.QuasiNewton(leave_saddles=False) if steps is None else jd.Alternating(steps)
    fit = patiently(
        "estimating",
        lambda: jd.estimate_rigidity(
            problem, observed, parts=label, solver=solver, progress=_show_evaluation
        ),
    )
    return problem, fit, None


def _fit_rings(
    problem: jd.Problem, observed, label: np.ndarray, most: int
) -> tuple[jd.Problem, jd.Estimate, list[int]]:
    def show(sizes: np.ndarray, misfit: float) -> None:
        console.print(f"rings {', '.join(map(str, sizes))}: misfit {100 * misfit:.3g} %")

    found = patiently(
        "estimating",
        lambda: jd.estimate_rings(problem, observed, parts=label, most=most, progress=show),
    )
    console.print(found.explain().splitlines()[0])
    return found.problem, found.fit, found.rings.tolist()


def _check_hold_out(hold_out: int, count: int) -> None:
    if hold_out >= count:
        raise jd.InputError(
            f"--hold-out {hold_out} leaves none of the {count} poses to fit: give fewer"
        )


def _check_names(out: Path) -> Path:
    """Return the name of the report beside the PLY file, or raise InputError."""
    check_output(out)
    if format_of(out) != ".ply":
        raise jd.InputError(f"{out}: only PLY carries rigidity per vertex: use a .ply name")
    report = without_suffix(out).with_suffix(".json")
    check_place(report)
    return report


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


def _handles(
    path: Path | None, mesh: jd.Mesh, observed: np.ndarray, tolerance: float | None
) -> tuple[np.ndarray, FoundHandles | None]:
    if path:
        return jd.load_handles(path, mesh).handles, None
    found = _moved_rigidly(mesh, observed, tolerance)
    return found.vertices, found


def _moved_rigidly(mesh: jd.Mesh, observed: np.ndarray, tolerance: float | None) -> FoundHandles:
    found = patiently("finding handles", lambda: search_handles(mesh, observed, tolerance))
    sizes = ", ".join(str(len(group.vertices)) for group in found.groups[:10])
    more = ", ..." if len(found.groups) > 10 else ""
    count = number_of(len(found.groups), "group", "groups")
    console.print(
        f"handles: {count} of vertices moved rigidly ({sizes}{more}), within "
        f"{found.tolerance:.2g} of the diagonal"
    )
    if found.doubt:
        console.print(
            f"the estimate depends on that: {found.doubt}. Compare another --tolerance, or give "
            "--handles"
        )
    return found


def _show_evaluation(evaluation: int, misfit: float, rigidity: np.ndarray) -> None:
    values = ", ".join(f"{value:.3g}" for value in rigidity[:5])
    console.print(f"evaluation {evaluation}: misfit {misfit:.4g}, rigidity {values}")
