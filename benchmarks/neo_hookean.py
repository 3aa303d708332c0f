"""Poses of solids by another model: tetrahedra of compressible neo-Hookean material.

The energy of a tetrahedron is its volume times ``mu / 2 (|F|^2 - 3) - mu log J + k / 2 (log J)^2``
with the deformation gradient F, ``J = det F`` and Lame's constants mu and k (Bonet and Wood 2008,
Sec. 6.4.3). Minimised by Newton's method, at first with the Hessian of each tetrahedron projected
to positive semidefinite (Teran et al. 2005), with a step that is halved until the energy falls.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

import jaxdeform as jd

# Corners of the six tetrahedra of a cube around its diagonal (Kuhn 1960), as paths of unit steps.
_PATHS = [(0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2), (2, 1, 0)]
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
# Newton's steps for one set of targets, and the force on the free nodes that ends them, as a
# fraction of all forces. The projected Hessian converges linearly: from the other fraction on it is
# the true one.
_STEPS, _TOLERANCE, _NEAR = 60, 1e-10, 1e-3


class Solid(NamedTuple):
    """A solid at rest."""

    nodes: Float[np.ndarray, "nodes 3"]
    tetrahedra: Int[np.ndarray, "tetrahedra 4"]

    def middles(self) -> Float[np.ndarray, "tetrahedra 3"]:
        """Return the middle of each tetrahedron."""
        return self.nodes[self.tetrahedra].mean(axis=1)

    def surface(self) -> tuple[jd.Mesh, Int[np.ndarray, "vertices"]]:
        """Return its surface as a mesh, and which node each vertex is."""
        faces = self.tetrahedra[:, _FACES].reshape(-1, 3)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        outer = faces[np.sort(first[count == 1])]
        used, number = np.unique(outer, return_inverse=True)
        return jd.Mesh(self.nodes[used], number.reshape(-1, 3)), used


def solid_box(cells: tuple[int, int, int], size: tuple[float, float, float]) -> Solid:
    """Return a box from the origin, of cubes cut into six tetrahedra each."""
    points = [n + 1 for n in cells]
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in points), indexing="ij"), axis=-1)
    nodes = grid.reshape(-1, 3) / cells * size
    corner = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), axis=-1)
    ways = []
    for path in _PATHS:
        steps = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[[*path]], 0)])
        ways.append(steps)
    corners = corner.reshape(-1, 1, 1, 3) + np.array(ways)
    tetrahedra = np.ravel_multi_index(np.moveaxis(corners, -1, 0), points).reshape(-1, 4)
    turned = np.linalg.det(_edges(nodes, tetrahedra)) < 0
    tetrahedra[turned] = tetrahedra[turned][:, [0, 2, 1, 3]]
    return Solid(nodes, tetrahedra)


def _edges(nodes, tetrahedra):
    corner = nodes[tetrahedra]
    return np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)


class NeoHookean:
    """A solid whose tetrahedra have a Young's modulus each, and one Poisson's ratio."""

    def __init__(self, solid: Solid, young: Float[np.ndarray, "tetrahedra"], poisson: float = 0.4):
        young = np.broadcast_to(np.asarray(young, float), len(solid.tetrahedra))
        edges = _edges(solid.nodes, solid.tetrahedra)
        self.solid = solid
        self._inverse = np.linalg.inv(edges)
        volume = np.linalg.det(edges) / 6.0
        shear = young / (2.0 * (1.0 + poisson))
        bulk = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
        self._constants = np.stack([volume * shear, volume * bulk], axis=1)

    def energy(self, nodes: Float[np.ndarray, "nodes 3"]) -> float:
        """Return the energy; infinite where a tetrahedron is inside out."""
        corner = nodes[self.solid.tetrahedra]
        return float(jnp.sum(_energies(corner, self._inverse, self._constants)))

    def poses(
        self, held: Int[np.ndarray, "held"], frames: Float[np.ndarray, "frames held 3"]
    ) -> Float[np.ndarray, "frames nodes 3"]:
        """Return the equilibria along a path of the held nodes, each from the last one."""
        nodes, found = self.solid.nodes.copy(), []
        for targets in frames:
            nodes = self._equilibrium(nodes, held, np.asarray(targets))
            found.append(nodes)
        return np.stack(found)

    def _equilibrium(self, nodes, held, targets):
        free = np.setdiff1d(np.arange(len(nodes)), held)
        columns = (3 * free[:, None] + np.arange(3)).ravel()
        nodes = self._carried(nodes, held, targets, columns)
        energy, project = self.energy(nodes), True
        for _ in range(_STEPS):
            force, hessian = self._derivatives(nodes, project)
            left = np.linalg.norm(force[columns]) / np.linalg.norm(force)
            if left <= _TOLERANCE:
                return nodes
            step = splu(hessian[columns][:, columns].tocsc()).solve(-force[columns])
            if not project and step @ force[columns] >= 0.0:
                raise RuntimeError("the equilibrium is a saddle: take other frames")
            nodes, energy = self._descended(nodes, free, step.reshape(-1, 3), energy)
            project = left > _NEAR
        raise RuntimeError(f"no equilibrium after {_STEPS} steps: take smaller frames")

    def _carried(self, nodes, held, targets, columns):
        """Move the held nodes, and all others as linear elasticity says."""
        _, hessian = self._derivatives(nodes, True)
        moved = np.zeros_like(nodes)
        moved[held] = targets - nodes[held]
        pull = hessian @ moved.ravel()
        moved.ravel()[columns] = splu(hessian[columns][:, columns].tocsc()).solve(-pull[columns])
        if not np.isfinite(self.energy(nodes + moved)):
            raise RuntimeError("a tetrahedron turned inside out: take smaller frames")
        return nodes + moved

    def _descended(self, nodes, free, step, energy):
        for halvings in range(40):
            tried = nodes.copy()
            tried[free] += step * 0.5**halvings
            new = self.energy(tried)
            # Near the end rounding hides the fall of the energy.
            if new <= energy * (1 + 1e-12):
                return tried, new
        raise RuntimeError("no step lowers the energy")

    def _derivatives(self, nodes, project):
        corner = nodes[self.solid.tetrahedra]
        force = _forces(corner, self._inverse, self._constants)
        hessian = np.asarray(_hessians(corner, self._inverse, self._constants))
        hessian = hessian.reshape(-1, 12, 12)
        if project:
            values, vectors = np.linalg.eigh(hessian)
            positive = vectors * np.maximum(values, 0.0)[:, None]
            hessian = positive @ np.swapaxes(vectors, 1, 2)
        index = (3 * self.solid.tetrahedra[:, :, None] + np.arange(3)).reshape(-1, 12)
        total = np.bincount(index.ravel(), np.asarray(force).ravel(), nodes.size)
        row, column = np.broadcast_arrays(index[:, :, None], index[:, None, :])
        matrix = sp.coo_matrix((hessian.ravel(), (row.ravel(), column.ravel())))
        return total, matrix.tocsr()


def _energy(corner, inverse, constants):
    gradient = (corner[1:] - corner[:1]).T @ inverse
    shear, bulk = constants
    volume = jnp.linalg.det(gradient)
    log = jnp.log(jnp.where(volume > 0, volume, 1.0))
    value = shear * ((jnp.sum(gradient**2) - 3.0) / 2.0 - log) + bulk * log**2 / 2.0
    return jnp.where(volume > 0, value, jnp.inf)


_energies = jax.jit(jax.vmap(_energy))
_forces = jax.jit(jax.vmap(jax.grad(_energy)))
_hessians = jax.jit(jax.vmap(jax.hessian(_energy)))
