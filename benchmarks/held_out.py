"""Do estimates predict poses that they have not seen? ``python -m benchmarks.held_out [FOLDER]``.

The poses are those of solid bars of neo-Hookean material: another model, so nothing fits exactly.
Three poses are fitted and three others predicted. With a folder that has them, scans of a cactus
and of a plate: one pose is fitted, another predicted. The error is the root mean square distance of
the free vertices, in per cent of the diagonal. Prints the tables of docs/estimation-measured.md.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import jaxdeform as jd
from benchmarks.neo_hookean import NeoHookean, Solid, solid_box
from jaxdeform._estimation.held_out import prediction_errors

SIZE = (30.0, 150.0, 30.0)
FRAMES = 8
"""From rest to each pose, so that no tetrahedron turns inside out on the way."""
FITTED = ("bend 60", "twist 80", "shift")
HELD_OUT = ("bend -50", "tilt 45", "press")
CONSTANTS = np.geomspace(1e-3, 1e3, 25)
"""Of the material, tried for the best constant: which needs the poses that are held out."""
SCANS = {
    "cactus": ("cactus0.ply", "cactus4.ply", "cactus5.ply"),
    "plate": ("plate4SD.ply", "plate4SD_rolledA.ply", "plate4SD_rolledB.ply"),
}
"""The rest shape and two poses of each family."""
TOLERANCES = {"cactus": None, "plate": 1e-4}
"""Of its handles; the plate's cannot be found without."""


class Bar(NamedTuple):
    """A solid bar, held at both ends, and its poses on the surface."""

    problem: jd.Problem
    poses: dict[str, Float[np.ndarray, "vertices 3"]]
    upper: np.ndarray

    def stack(self, names: tuple[str, ...]) -> Float[np.ndarray, "poses vertices 3"]:
        """Return some of the poses."""
        return np.stack([self.poses[name] for name in names])


def make_bar(young) -> Bar:
    """Return a bar whose Young's modulus is a function of the height, from 0 to 1."""
    solid = solid_box((4, 20, 4), SIZE)
    mesh, node = solid.surface()
    height = solid.nodes[:, 1] / SIZE[1]
    held = np.flatnonzero((height < 0.06) | (height > 0.94))
    model = NeoHookean(solid, young(solid.middles()[:, 1] / SIZE[1]))
    poses = {name: model.poses(held, path)[-1][node] for name, path in _paths(solid, held).items()}
    problem = jd.precompute(mesh, np.flatnonzero(np.isin(node, held)))
    return Bar(problem, poses, (mesh.vertices[:, 1] > SIZE[1] / 2).astype(int))


def _paths(solid: Solid, held: np.ndarray) -> dict[str, Float[np.ndarray, "frames held 3"]]:
    rest = solid.nodes[held]
    upper = (rest[:, 1] > SIZE[1] / 2)[:, None]
    middle = np.array([SIZE[0] / 2, 60.0, SIZE[2] / 2])
    moves = {
        "bend 60": lambda s: jd.bend(rest, 60.0 * s),
        "twist 80": lambda s: jd.twist(rest, 80.0 * s),
        "shift": lambda s: rest + s * np.array([0.0, 0.0, 40.0]),
        "bend -50": lambda s: jd.bend(rest, -50.0 * s),
        "tilt 45": lambda s: jd.rotate(rest, 45.0 * s, axis=[1.0, 0.0, 0.0], center=middle),
        "press": lambda s: rest + s * np.array([10.0, -12.0, 0.0]),
    }
    parts = np.arange(1, FRAMES + 1) / FRAMES
    return {
        name: np.stack([np.where(upper, np.asarray(move(s)), rest) for s in parts])
        for name, move in moves.items()
    }


def constant_errors(problem: jd.Problem, seen, unseen, **given: Any) -> dict[str, float]:
    """Return the errors of ARAP and of one material for all, in per cent of the diagonal."""
    constants = [error(problem, unseen, jd.rigidity_from_material(problem, x)) for x in CONSTANTS]
    return {
        "ARAP": error(problem, unseen, 0.0, jd.RotationFit()),
        "best constant": min(constants),
        "fitted constant": error(
            problem, unseen, jd.estimate_rigidity(problem, seen, **given).field
        ),
    }


def error(problem: jd.Problem, unseen, rigidity, local: Any = None) -> float:
    """Return how far the predictions of poses are off on average, in per cent of the diagonal."""
    return 100.0 * float(prediction_errors(problem, unseen, rigidity, local or jd.Newton()).mean())


def solid_errors(young) -> dict[str, float]:
    """Return the mean error of each way to predict a solid, as in `make_bar`."""
    bar = make_bar(young)
    problem, seen, unseen = bar.problem, bar.stack(FITTED), bar.stack(HELD_OUT)
    targets = seen[:, problem.handles]
    halves = jd.estimate_rigidity(problem, seen, targets=targets, parts=bar.upper)
    field = jd.estimate_rigidity_field(problem, seen, targets=targets, smoothness=1e-4)
    return constant_errors(problem, seen, unseen, targets=targets) | {
        "fitted halves": error(problem, unseen, halves.field),
        "fitted field": error(problem, unseen, field.field),
    }


def scan_errors(
    rest: jd.Mesh, fitted: np.ndarray, predicted: np.ndarray, tolerance: float | None
) -> dict[str, float]:
    """Return the error of each way to predict a scan, with the handles that are found."""
    handles = jd.find_handles(rest, np.stack([fitted, predicted]), tolerance=tolerance)
    problem = jd.precompute(rest, handles)
    field = jd.estimate_rigidity_field(problem, fitted, smoothness=1e-4)
    sizes = jd.estimate_rings(problem, fitted)
    return constant_errors(problem, fitted, predicted) | {
        "fitted constant and rings": error(sizes.problem, predicted, sizes.fit.field),
        "fitted field": error(problem, predicted, field.field),
    }


def scans(folder: Path) -> dict[str, Callable[[], dict[str, float]]]:
    """Return what computes each row of the table of scans."""
    rows = {}
    for name, files in SCANS.items():
        rest, *poses = (jd.load_mesh(folder / file) for file in files)
        for first, second in ((0, 1), (1, 0)):
            pair = poses[first].vertices, poses[second].vertices
            label = f"{name}, {Path(files[1 + first]).stem} to {Path(files[1 + second]).stem}"
            rows[label] = partial(scan_errors, rest, *pair, TOLERANCES[name])
    return rows


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    solids = {
        "one material": lambda height: np.ones_like(height),
        "halves of 1 and 10": lambda height: np.where(height > 0.5, 10.0, 1.0),
        "a band of 10 in 1": lambda height: np.where(np.abs(height - 0.5) < 0.17, 10.0, 1.0),
    }
    rows = {name: partial(solid_errors, young) for name, young in solids.items()}
    if len(sys.argv) > 1:
        rows = scans(Path(sys.argv[1]))
    for number, (name, errors) in enumerate(rows.items()):
        row = errors()
        if number == 0:
            print("| |", " | ".join(row), "|")
            print("|---" * (len(row) + 1) + "|")
        print(f"| {name} |", " | ".join(f"{value:.3g}" for value in row.values()), "|", flush=True)


if __name__ == "__main__":
    main()
