"""Meshes with handles, targets and a common start; the peers that solve them."""

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np

import jaxdeform as jd


@dataclass(frozen=True, eq=False)
class Workload:
    name: str
    mesh: jd.Mesh
    handles: np.ndarray
    targets: np.ndarray

    @cached_property
    def start(self) -> np.ndarray:
        """The first guess that all methods get: Laplacian editing."""
        return np.array(jd.laplacian_editing(self.mesh, self.handles, self.targets))

    def libigl(self, steps: int) -> igl.ARAPData:
        data = igl.ARAPData()
        data.energy = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_SPOKES
        data.max_iter = steps
        igl.arap_precomputation(self.mesh.vertices, self.mesh.faces, 3, self.handles, data)
        return data

    def run_libigl(self, data: igl.ARAPData, steps: int, start=None) -> np.ndarray:
        data.max_iter = steps
        return np.asarray(
            igl.arap_solve(self.targets, data, (self.start if start is None else start).copy())
        )


def bar() -> Workload:
    """The thesis's bend: 722 vertices."""
    mesh = jd.shapes.bar()
    return _bent("bar", mesh, (mesh.vertices[:, 1] < 6) | (mesh.vertices[:, 1] > 145))


def cylinder() -> Workload:
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
    """Rings of m vertices, about 6 m of them, so that the triangles are nearly equilateral."""
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


def _bent(name: str, mesh: jd.Mesh, held: np.ndarray, degrees: float = 90.0) -> Workload:
    handles = np.flatnonzero(held)
    return Workload(name, mesh, handles, np.asarray(jd.bend(mesh.vertices[handles], degrees)))


def _moved(name, mesh, fixed, moving, offset) -> Workload:
    handles = np.concatenate([fixed, moving])
    turned = jd.rotate(mesh.vertices[moving], 30.0, axis="y", center=[0.0, 0.0, 0.0])
    targets = np.concatenate([mesh.vertices[fixed], np.asarray(turned) + np.array(offset)])
    return Workload(name, mesh, handles, targets)
