"""Meshes with handles, targets and a common start, and libigl to deform them."""

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np

import jaxdeform as jd

MATERIAL = 0.2
"""The scale-free material constant of suites that name no rigidity."""


def material(problem: jd.Problem):
    """Return the rigidity (vertices,) of that material."""
    return jd.rigidity_from_material(problem, MATERIAL)


@dataclass(frozen=True, eq=False)
class Workload:
    """One deformation: a mesh, its handles and where they go."""

    name: str
    mesh: jd.Mesh
    handles: np.ndarray
    targets: np.ndarray
    other_start: np.ndarray | None = None

    @cached_property
    def start(self) -> np.ndarray:
        """The start that all methods get: Laplacian editing, unless another was given."""
        if self.other_start is not None:
            return self.other_start
        return np.array(jd.laplacian_editing(self.mesh, self.handles, self.targets))

    def reduced_energy(self, problem: jd.Problem, vertices, rigidity, local: jd.LocalStep) -> float:
        """Return min over T of Eq. 4.4 at given positions: one functional for every method."""
        once = jd.Alternating(1)
        out = jd.deform(problem, self.targets, rigidity, local=local, start=vertices, solver=once)
        return float(out.energy[0])

    def libigl(self, steps: int) -> igl.ARAPData:
        """Precompute ARAP as libigl does."""
        data = igl.ARAPData()
        data.energy = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_SPOKES
        data.max_iter = steps
        igl.arap_precomputation(self.mesh.vertices, self.mesh.faces, 3, self.handles, data)
        return data

    def run_libigl(self, data: igl.ARAPData, steps: int, start=None) -> np.ndarray:
        """Return the positions after that many iterations of libigl's ARAP."""
        data.max_iter = steps
        return np.asarray(
            igl.arap_solve(self.targets, data, (self.start if start is None else start).copy())
        )


def bar() -> Workload:
    """The thesis's bend: 722 vertices."""
    mesh = jd.shapes.bar()
    return _bent("bar", mesh, (mesh.vertices[:, 1] < 6) | (mesh.vertices[:, 1] > 145))


def small_bar() -> jd.Mesh:
    """Return the bar decimated to 262 vertices."""
    whole = jd.shapes.bar()
    vertices, faces, *_ = igl.decimate(whole.vertices, whole.faces, 520)
    return jd.Mesh(vertices, faces)


def cylinder() -> Workload:
    """A closed cylinder bent by 90 degrees: 4,802 vertices."""
    mesh = jd.shapes.cylinder()
    y = mesh.vertices[:, 1]
    return _bent("cylinder", mesh, (y < 0.5) | (y > 11.5))


def cactus() -> Workload:
    """One arm pulled aside and turned, the foot held: 5,100 vertices."""
    mesh = jd.shapes.cactus()
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    foot, tip = np.flatnonzero(y < 0), np.flatnonzero((x > 0.9) & (y > 3.2))
    return _moved("cactus", mesh, foot, tip, [0.5, -0.4, 0.4])


def octopus(vertices: int) -> Workload:
    """The head held, the eight tips lifted and turned about the axis by 30 degrees."""
    mesh = jd.shapes.octopus(vertices)
    head = np.flatnonzero(mesh.vertices[:, 1] > 1.2)
    tips = np.flatnonzero(np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2]) > 2.6)
    return _moved(f"octopus, {mesh.n_vertices:,} vertices", mesh, head, tips, [0.0, 1.0, 0.0])


def tube(vertices: int) -> Workload:
    """A long open tube with a regular mesh, made fast at any size, bent by 45 degrees."""
    mesh = fine_tube(vertices)
    y = mesh.vertices[:, 1]
    return _bent(f"tube, {mesh.n_vertices:,} vertices", mesh, (y < 0.04) | (y > 0.96), 45.0)


def fine_tube(vertices: int) -> jd.Mesh:
    """Return about 6 m rings of m vertices each, so that triangles are nearly equilateral."""
    m = max(8, round((vertices / 6) ** 0.5))
    along = round(vertices / m)
    angle = 2 * np.pi * np.arange(m) / m
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1) / (2 * np.pi * 6)
    height = np.linspace(0, 1, along)[:, None, None] * np.array([0.0, 1.0, 0.0])
    first = np.arange(along - 1)[:, None] * m
    here, there = (first + np.arange(m)).ravel(), (first + np.roll(np.arange(m), -1)).ravel()
    low = np.stack([here, here + m, there + m], axis=1)
    high = np.stack([here, there + m, there], axis=1)
    return jd.Mesh((ring[None] + height).reshape(-1, 3), np.concatenate([low, high]))


def _bent(name: str, mesh: jd.Mesh, at_ends: np.ndarray, degrees: float = 90.0) -> Workload:
    handles = np.flatnonzero(at_ends)
    return Workload(name, mesh, handles, np.asarray(jd.bend(mesh.vertices[handles], degrees)))


def _moved(name, mesh, fixed, moving, offset) -> Workload:
    handles = np.concatenate([fixed, moving])
    turned = jd.rotate(mesh.vertices[moving], 30.0, axis="y", center=[0.0, 0.0, 0.0])
    targets = np.concatenate([mesh.vertices[fixed], np.asarray(turned) + np.array(offset)])
    return Workload(name, mesh, handles, targets)
