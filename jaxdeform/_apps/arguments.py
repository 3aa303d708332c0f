"""What the command line is given: poses, parts, a rigidity, a folder."""

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxdeform as jd
from jaxdeform._errors import shown
from jaxdeform._mesh.reading import read_json, read_text
from jaxdeform._mesh.select import some_where
from jaxdeform._mesh.selection import check_parts
from jaxdeform._mesh.words import real
from jaxdeform._values import read_rigidity

MEDIUM = 0.2
"""A material between rubber and steel, for `rigidity_from_material`."""


def read_pose(path: Path, rest: jd.Mesh, name: Path) -> np.ndarray:
    pose = jd.load_mesh(path)
    # Polygons of a pose may have been cut along other diagonals.
    polygons = pose.source and rest.source and pose.source.polygons.same(rest.source.polygons)
    same = polygons or np.array_equal(pose.faces, rest.faces)
    if pose.n_vertices != rest.n_vertices or not same:
        raise jd.InputError(
            f"{path}: is not a pose of {name}: {pose} and {rest} must have the same vertices and "
            "faces, in the same order"
        )
    return pose.vertices


def read_parts(path: Path, mesh: jd.Mesh) -> np.ndarray:
    if path.suffix.lower() == ".json":
        values = read_json(path)
    else:
        values = [_number(word) for word in read_text(path).split()]
    if not isinstance(values, list):
        raise jd.InputError(f"{path}: give a list of one integer per vertex")
    for vertex, value in enumerate(values):  # before an array, which would take true for 1
        if type(value) is not int:
            raise jd.InputError(
                f"{path}: the part of vertex {vertex} is {shown(value)}: give an integer, "
                "counted from 0 without gaps"
            )
    try:
        return check_parts(values, mesh)
    except jd.InputError as error:
        raise jd.InputError(f"{path}: {error}") from error


def choose_parts(path: Path | None, expressions: list[str], mesh: jd.Mesh) -> np.ndarray:
    """Return the part of each vertex, from a file or by expressions; without either, 0."""
    if path is None:
        return parts_by_place(expressions, mesh)
    if expressions:
        raise jd.InputError("--part and --parts are two ways to name the parts: give one of them")
    return read_parts(path, mesh)


def parts_by_place(expressions: list[str], mesh: jd.Mesh) -> np.ndarray:
    """Return the part of each vertex: 1 where the first expression holds, and so on; else 0."""
    label = np.zeros(mesh.n_vertices, int)
    for number, expression in enumerate(expressions, 1):
        label[some_where(mesh, expression, "--part").mask] = number
    for number, size in enumerate(np.bincount(label, minlength=len(expressions) + 1)):
        if not size:
            which = "what no --part names" if number == 0 else shown(expressions[number - 1])
            raise jd.InputError(
                f"--part: no vertex is left for part {number}, {which}: leave out an expression "
                "that covers it"
            )
    return label


def _number(word: str) -> int | str:
    """Return the integer, or the word if it is none."""
    return int(word) if re.fullmatch(r"[+-]?[0-9]{1,18}", word) else word


def parse_rigidity(text: str, mesh: jd.Mesh) -> np.ndarray:
    try:
        values = np.asarray(real(text.encode(errors="replace")))
    except ValueError:
        if not os.path.exists(text):  # False too for a name that no file can have
            raise jd.InputError(
                f"--rigidity {text}: is neither a number nor a file: give a number or a PLY file"
            ) from None
        values = jd.load_rigidity(text)
    try:
        read_rigidity(values, mesh.n_vertices, values.dtype)
    except jd.InputError as error:
        raise jd.InputError(f"--rigidity {text}: {error}") from error
    return values


def make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise jd.InputError(
            f"{folder}: cannot be made ({error.strerror}): choose another folder"
        ) from error


class Material(NamedTuple):
    """The rigidity that the options give."""

    base: np.ndarray | None
    """One number, or one per vertex; None for a medium material."""
    regions: list[tuple[jd.Selection, float]]
    """Where it is another number. A later one wins."""

    @property
    def varies(self) -> bool:
        """Whether there is something to see in colours."""
        return bool(self.regions) or (self.base is not None and self.base.ndim > 0)

    def at(self, problem: jd.Problem) -> np.ndarray:
        """Return the rigidity of each vertex."""
        base = jd.rigidity_from_material(problem, MEDIUM) if self.base is None else self.base
        values = np.broadcast_to(np.asarray(base), (problem.n_vertices,)).copy()
        for chosen, value in self.regions:
            values[chosen.mask] = value
        return values


def read_material(mesh: jd.Mesh, rigidity: str | None, regions: list[str]) -> Material:
    """Return the rigidity from ``--rigidity`` and from each ``--stiff``, "EXPR: VALUE"."""
    base = None if rigidity is None else parse_rigidity(rigidity, mesh)
    found = []
    for region in regions:
        expression, _, word = region.rpartition(":")
        try:
            value = np.asarray(real(word.encode(errors="replace")))
        except ValueError:
            raise jd.InputError(
                f"--stiff: {shown(word.strip())} is not a number: give --stiff EXPR VALUE, such as "
                '--stiff "y > 0.5" 30'
            ) from None
        try:
            read_rigidity(value, mesh.n_vertices, value.dtype)
        except jd.InputError as error:
            raise jd.InputError(f"--stiff: {error}") from error
        found.append((some_where(mesh, expression, "--stiff"), float(value)))
    return Material(base, found)
