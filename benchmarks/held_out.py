"""Do estimates predict poses that they have not seen? ``python -m benchmarks.held_out``.

The poses are those of solid bars of neo-Hookean material: another model, so nothing fits exactly.
Three poses are fitted and three others predicted. The error is the root mean square distance of the
free vertices, in per cent of the diagonal. Prints the table of docs/estimation.md.
"""

from typing import NamedTuple

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
CONSTANTS = 10.0 ** np.arange(-3, 2)
"""Of the material, tried for the best constant: which needs the poses that are held out."""


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


def errors(bar: Bar) -> dict[str, float]:
    """Return the mean error of each way to predict, in per cent of the diagonal."""
    problem, seen, unseen = bar.problem, bar.stack(FITTED), bar.stack(HELD_OUT)
    targets = seen[:, problem.handles]

    def error(rigidity, local=None) -> float:
        found = prediction_errors(problem, unseen, rigidity, local or jd.Newton())
        return 100.0 * float(found.mean())

    def fitted(parts=None) -> float:
        return error(jd.estimate_rigidity(problem, seen, targets=targets, parts=parts).field)

    constants = [error(jd.rigidity_from_material(problem, x)) for x in CONSTANTS]
    field = jd.estimate_rigidity_field(problem, seen, targets=targets, smoothness=1e-4)
    return {
        "ARAP": error(0.0, jd.RotationFit()),
        "best constant": min(constants),
        "fitted constant": fitted(),
        "fitted halves": fitted(bar.upper),
        "fitted field": error(field.field),
    }


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    bars = {
        "one material": lambda height: np.ones_like(height),
        "halves of 1 and 10": lambda height: np.where(height > 0.5, 10.0, 1.0),
        "a band of 10 in 1": lambda height: np.where(np.abs(height - 0.5) < 0.17, 10.0, 1.0),
    }
    for number, (name, young) in enumerate(bars.items()):
        row = errors(make_bar(young))
        if number == 0:
            print("| solid bar |", " | ".join(row), "|")
            print("|---" * (len(row) + 1) + "|")
        print(f"| {name} |", " | ".join(f"{value:.2f}" for value in row.values()), "|", flush=True)


if __name__ == "__main__":
    main()
