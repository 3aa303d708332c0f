"""The command ``jaxdeform deform``."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import typer
from jaxtyping import Float
from typer.core import TyperCommand

import jaxdeform as jd
from jaxdeform._apps.arguments import MEDIUM, Material, read_material
from jaxdeform._apps.methods import Method, MethodSettings
from jaxdeform._apps.moves import Motion, Moves, moves_by_place, moves_of_file
from jaxdeform._apps.output import Output
from jaxdeform._apps.talk import console, counted, patiently, since
from jaxdeform._checks import check_tolerance
from jaxdeform._errors import first_few

# Options that a method does not read.
_RIGIDITY = "--rigidity", "--stiff"
_UNREAD = {
    Method.material: ("--alpha",),
    Method.arap: ("--rings", *_RIGIDITY, "--alpha"),
    Method.rc_arap: (*_RIGIDITY, "--alpha"),
    Method.sr_arap: ("--rings", *_RIGIDITY, "--normals"),
    Method.laplacian: ("--rings", *_RIGIDITY, "--steps", "--normals", "--alpha"),
}


class DeformCommand(TyperCommand):
    """Takes ``--stiff EXPR VALUE`` several times, and refuses to forget the first of two motions.

    Typer has options that may be repeated and options with two values, but none that are both. So
    the two words go on as one, "EXPR: VALUE".
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words of the command."""
        for name in ("--move", "--rotate", "--about", "--translate"):
            if sum(word.split("=")[0] == name for word in args) > 1:
                raise jd.InputError(
                    f"{name} is given twice: join expressions by 'or'; groups that move "
                    "differently go into a handle file (--handles)"
                )
        words = iter(args)
        joined = []
        for word in words:
            joined.append(word)
            if word == "--stiff":
                pair = [value for _, value in zip(range(2), words, strict=False)]
                joined += [": ".join(pair)] if pair else []
        return super().parse_args(ctx, joined)


_WHERE = "an expression of x, y, z, such as 'y < 0.1' (u, v, w: from 0 to 1 in the bounding box)"
_Point = tuple[float, float, float] | None
HandleFile = Annotated[
    Path | None, typer.Option(help="Handle file: .json, or .sel with a .def of the same name.")
]
Fix = Annotated[
    list[str] | None,
    typer.Option(metavar="EXPR", help=f"Vertices that stay: {_WHERE}. May be repeated."),
]
Move = Annotated[str | None, typer.Option(metavar="EXPR", help="Vertices that move.")]
Rotate = Annotated[
    tuple[str, float] | None,
    typer.Option(metavar="AXIS DEGREES", help="Rotate them about x, y or z."),
]
About = Annotated[
    _Point,
    typer.Option(metavar="X Y Z", help="Centre of the rotation. By default their centroid."),
]
Translate = Annotated[_Point, typer.Option(metavar="X Y Z", help="Then translate them.")]
Rigidity = Annotated[
    str | None,
    typer.Option(
        help="A number, or a PLY file with one rigidity per vertex. By default, that of a medium "
        f"material: {MEDIUM} times the area of each cell."
    ),
]
Stiff = Annotated[
    list[str] | None,
    typer.Option(
        metavar="EXPR VALUE",
        help="Another rigidity for some vertices. May be repeated; the last one wins.",
    ),
]
Rings = Annotated[
    int | None, typer.Option(min=1, help="Size of the cells, in rings of vertices. By default 1.")
]
Alpha = Annotated[
    float | None,
    typer.Option(
        help="With --method sr-arap: how alike the rotations of neighbours are. By default 0.02."
    ),
]
Steps = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of alternating steps. By default, until convergence (100 with --normals).",
    ),
]

Frames = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=9999,
        help="Go there in so many even steps, each from the one before, and write each as a file: "
        "-o out.obj writes out_0001.obj and so on. Targets of a handle file are reached on "
        "straight lines. The only way to turn by 360 degrees.",
    ),
]


def deform(
    mesh: Annotated[Path, typer.Argument(help="OBJ, OFF, PLY or STL file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Mesh file to write.")],
    fix: Fix = None,
    move: Move = None,
    rotate: Rotate = None,
    about: About = None,
    translate: Translate = None,
    handles: HandleFile = None,
    motion: Annotated[
        Path | None, typer.Option(help="The .def file of a .sel handle file.")
    ] = None,
    method: Annotated[Method, typer.Option(help="How the rest follows.")] = Method.material,
    rigidity: Rigidity = None,
    stiff: Stiff = None,
    rings: Rings = None,
    alpha: Alpha = None,
    steps: Steps = None,
    frames: Frames = None,
    normals: Annotated[bool, typer.Option(help="Add the normal term (Eq. 4.7).")] = False,
    picture: Annotated[
        Path | None,
        typer.Option(help="PNG file for a picture of both shapes; with --frames also a GIF."),
    ] = None,
) -> None:
    """Move some vertices of a mesh and hold others; the rest of it follows.

    The vertices are chosen by --fix and --move, or by a handle file.
    """
    shape = jd.load_mesh(mesh)
    output = Output(out, frames, picture)
    output.check(shape)  # all arguments are checked before the long work
    options = {"--rigidity": rigidity, "--stiff": stiff, "--rings": rings}
    options |= {"--steps": steps, "--normals": normals}
    given = {name for name, value in options.items() if value}
    if alpha is not None:
        alpha = check_tolerance("--alpha", alpha)
        given.add("--alpha")
    for name in _UNREAD[method]:
        if name in given:
            raise jd.InputError(f"{name} means nothing to --method {method.value}: leave it out")
    moves = _read_moves(shape, handles, motion, fix, move, Motion(rotate, about, translate))
    material = read_material(shape, rigidity, stiff or [])
    console.print(str(moves))
    if method.has_energy:
        settings = MethodSettings(method, rings or 1, alpha, steps, normals)
        result = _deformed(shape, moves, material, settings, frames)
    else:
        result = _edited(shape, moves, frames)
    # The result first, then words about it: whatever happens to those, the work is kept.
    output.save(shape, result.poses, result.rigidity)
    for line in result.words:
        console.print(line)
    output.say_wrote()
    output.draw(shape, moves, result.poses, result.rigidity if material.varies else None)


def _read_moves(
    shape: jd.Mesh,
    handles: Path | None,
    sel_motion: Path | None,
    fix: list[str] | None,
    move: str | None,
    motion: Motion,
) -> Moves:
    given = {"--fix": fix, "--move": move}
    given |= {f"--{name}": value for name, value in motion._asdict().items()}
    named = [name for name, value in given.items() if value]
    if handles is not None:
        if named:
            raise jd.InputError(
                f"{named[0]} and --handles are two ways to choose vertices: give one of them"
            )
        return moves_of_file(shape, handles, sel_motion)
    if sel_motion is not None:
        raise jd.InputError("--motion is the .def file of a .sel file: give that by --handles")
    if not named:
        raise jd.InputError(
            "no vertices are chosen: give --fix EXPR and --move EXPR with --rotate or --translate, "
            "or --handles FILE"
        )
    return moves_by_place(shape, fix or [], move, motion)


class _Result(NamedTuple):
    poses: Float[np.ndarray, "frames vertices 3"]
    rigidity: Float[np.ndarray, "vertices"] | None
    words: list[str]


def _edited(shape: jd.Mesh, moves: Moves, frames: int | None) -> _Result:
    began = time.perf_counter()

    def edit() -> np.ndarray:
        run = jd.laplacian_editor(shape, moves.handles)
        return np.stack([np.asarray(run(targets)) for targets in moves.path(frames or 1)])

    return _Result(patiently("editing", edit), None, [f"edited in {since(began)}"])


def _deformed(
    shape: jd.Mesh, moves: Moves, material: Material, settings: MethodSettings, frames: int | None
) -> _Result:
    began = time.perf_counter()
    problem = patiently("precomputing", lambda: settings.precompute(shape, moves.handles))
    console.print(f"{shape}, {len(moves.handles)} handles: precomputed in {since(began)}")
    began = time.perf_counter()
    values = settings.rigidity(material, problem)
    shown = values if settings.method.has_rigidity else None
    if frames is None:
        one = patiently("deforming", lambda: settings.deform(problem, moves.targets, values))
        energy, done = float(one.energy[-1]), int(one.steps)
        words = [f"energy {energy:.6g} after {done} steps in {since(began)}", one.explain()]
        return _Result(np.asarray(one.vertices)[None], shown, words)
    path = moves.path(frames)
    run = lambda tell: settings.deform_path(problem, path, values, tell)  # noqa: E731
    all_ = counted("deforming", frames, run)
    energy, done = float(all_.energy[-1, -1]), int(all_.steps.sum())
    words = [f"energy {energy:.6g} in the last frame, after {done} steps in {since(began)}"]
    words += list(_told(all_, frames))
    return _Result(np.asarray(all_.vertices), shown, words)


def _told(path: jd.Solution, frames: int) -> Iterator[str]:
    """Say how many frames ended how, and which are not as they should be."""
    ok, flipped = np.asarray(path.ok), np.asarray(path.flipped) > 0
    ends: dict[str, list[int]] = {}
    for k in range(frames):
        sentence = jd.Result[jax.tree.map(lambda x, k=k: x[k], path.result)]
        ends.setdefault(sentence, []).append(k)
    for sentence, which in ends.items():
        named = "" if ok[which[0]] else f" ({_numbers(which)})"
        yield f"{len(which)} of {frames} frames{named}: {sentence}"
    if flipped.any():
        which = np.flatnonzero(flipped).tolist()
        yield f"{len(which)} of {frames} frames ({_numbers(which)}) have cells inside out"
    for k in np.flatnonzero(path.jumped):
        before, after = (f"{float(path.energy[j, -1]):.4g}" for j in (k - 1, k))
        yield (
            f"frame {k + 1}: the shape jumped to another equilibrium (energy {before} to {after}): "
            "a part of the motion may be lost"
        )


def _numbers(frames: list[int]) -> str:
    """Return the numbers of the first frames, from 1, as their files have them."""
    return first_few([k + 1 for k in frames])
