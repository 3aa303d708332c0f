"""Which vertices the command ``deform`` holds, and where it moves them."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

import jaxdeform as jd
from jaxdeform._errors import number_of
from jaxdeform._mesh.select import some_where


class Motion(NamedTuple):
    """The rigid motion of the moved vertices, as the options give it."""

    rotate: tuple[str, float] | None
    """Axis and degrees."""
    about: tuple[float, float, float] | None
    """A point on the axis; by default the centroid of the moved vertices."""
    translate: tuple[float, float, float] | None

    def check(self) -> None:
        """Raise InputError unless it moves something."""
        if not (self.rotate or self.translate):
            raise jd.InputError(
                "--move needs --rotate AXIS DEGREES, --translate X Y Z, or both; to hold vertices "
                "use --fix"
            )
        if self.about and not self.rotate:
            raise jd.InputError("--about is the centre of a rotation: give --rotate AXIS DEGREES")

    def fraction(self, share: float) -> "Motion":
        """Return this share of the motion, from 0 to 1."""
        rotate = self.rotate and (self.rotate[0], share * self.rotate[1])
        x, y, z = self.translate or (0.0, 0.0, 0.0)
        return Motion(rotate, self.about, (share * x, share * y, share * z))

    def turns_in_place(self, points: Float[np.ndarray, "points 3"], size: float) -> bool:
        """Return whether these points lie on the axis of a rotation without a translation."""
        if self.rotate is None or any(self.translate or ()) or self.about:
            return False
        quarter = self._replace(rotate=(self.rotate[0], 90.0)).of(points)
        return bool(np.abs(quarter - points).max() <= 1e-12 * max(size, np.abs(points).max()))

    def of(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Return where these points move to: rotated, then translated."""
        option = "--rotate"
        try:
            if self.rotate:
                axis, degrees = self.rotate
                points = np.asarray(jd.rotate(points, degrees, axis=axis, center=self.about))
            option = "--translate"
            return np.asarray(jd.translate(points, self.translate or (0.0, 0.0, 0.0)))
        except jd.InputError as error:
            raise jd.InputError(f"{option}: {error}") from error


class Moves(NamedTuple):
    """The handles of a command."""

    handles: Int[np.ndarray, "handles"]
    rest: Float[np.ndarray, "handles 3"]
    targets: Float[np.ndarray, "handles 3"]
    moved: Bool[np.ndarray, "handles"]
    """False for a handle that stays where it is."""
    motion: Motion | None
    """Of the moved handles; None if a file gives the targets."""

    def __str__(self) -> str:
        """Return how many vertices were chosen."""
        moved = int(self.moved.sum())
        fixed, moved = (
            number_of(n, "vertex", "vertices") for n in (len(self.moved) - moved, moved)
        )
        return f"fixed: {fixed}, moved: {moved}"

    def path(self, frames: int) -> Float[np.ndarray, "frames handles 3"]:
        """Return the targets in even steps; the last ones are ``targets``.

        A motion turns by even angles and shifts by even lengths. Targets of a file are reached on
        straight lines.
        """
        return np.stack([self._after((k + 1) / frames) for k in range(frames)])

    def _after(self, share: float) -> Float[np.ndarray, "handles 3"]:
        if self.motion is None:
            return (1 - share) * self.rest + share * self.targets
        at = self.rest.copy()
        at[self.moved] = self.motion.fraction(share).of(at[self.moved])
        return at


def moves_of_file(mesh: jd.Mesh, path: Path, motion: Path | None) -> Moves:
    handles, targets = jd.load_handles(path, mesh, motion)
    rest = mesh.vertices[handles]
    return Moves(handles, rest, targets, (targets != rest).any(axis=1), None)


def moves_by_place(mesh: jd.Mesh, fix: list[str], move: str | None, motion: Motion) -> Moves:
    """Return the moves of vertices that expressions choose, or raise InputError."""
    fixed = jd.select.mask(mesh, np.zeros(mesh.n_vertices, bool))
    for expression in fix:
        fixed |= some_where(mesh, expression, "--fix")
    if move is None:
        raise jd.InputError("nothing moves: give --move EXPR with --rotate or --translate")
    motion.check()
    moved = some_where(mesh, move, "--move")
    both = fixed & moved
    if len(both):
        raise jd.InputError(
            f"--fix and --move both choose {number_of(len(both), 'vertex', 'vertices')} (vertex "
            f"{both.vertices[0]}): let one of them leave out what the other has"
        )
    handles = (fixed | moved).vertices
    grabbed = moved.mask[handles]
    targets = mesh.vertices[handles]
    targets[grabbed] = motion.of(targets[grabbed])
    if motion.turns_in_place(mesh.vertices[handles[grabbed]], mesh.diagonal):
        raise jd.InputError(
            "--rotate: the "
            + number_of(int(grabbed.sum()), "vertex of --move lies", "vertices of --move lie")
            + " on the axis, which goes through the middle, so nothing moves: give --about X Y "
            "Z, or choose more vertices"
        )
    return Moves(handles, mesh.vertices[handles], targets, grabbed, motion)
