"""Connected groups of vertices that moved rigidly."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._mesh.grouping import summed
from jaxdeform._mesh.mesh import Mesh

# Rounds of growing and fitting again. Real meshes need 3 to 8.
_GROWTHS = 50


class RigidGroup(NamedTuple):
    """Vertices that moved together: ``p' = R p + t`` in every pose.

    **Fields**

    - vertices: (members,) indices, ascending.
    - rotations: (poses, 3, 3) R.
    - translations: (poses, 3) t.
    - error: largest distance of a vertex from where that motion puts it.
    """

    vertices: Int[np.ndarray, "members"]
    rotations: Float[np.ndarray, "poses 3 3"]
    translations: Float[np.ndarray, "poses 3"]
    error: float

    @property
    def degrees(self) -> Float[np.ndarray, "poses"]:
        """Angle of each rotation."""
        cosine = (np.trace(self.rotations, axis1=1, axis2=2) - 1.0) / 2.0
        return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


class RigidGroups:
    """Finds the groups of a mesh in its poses, for any tolerance."""

    def __init__(self, mesh: Mesh, poses: Float[np.ndarray, "poses vertices 3"]) -> None:
        n = mesh.n_vertices
        i, j = mesh.edges.T
        ones = np.ones(len(i), np.int8)
        half = sp.coo_matrix((ones, (i, j)), (n, n))
        self.mesh, self._poses = mesh, poses
        self._graph = sp.csr_matrix(half + half.T)
        self._rings = _ring_errors(mesh.vertices, poses, self._graph)

    def noise_floor(self) -> float:
        """Return the noise (a fraction of the diagonal) of the rings that moved most rigidly.

        It is the RMS of a coordinate about a ring's own rigid motion, of the fifth ring from below,
        or on large meshes of one in 200: with six neighbours, one pose and noise alone about 0.55
        times its standard deviation.
        """
        errors = np.sort(self._rings.mean[np.isfinite(self._rings.mean)])
        floor = errors[min(max(4, len(errors) // 200), len(errors) - 1)]
        return float(floor) / self.mesh.diagonal

    def within(self, tolerance: float) -> tuple[RigidGroup, ...]:
        """Return the groups that moved rigidly within a fraction of the diagonal, largest first.

        A vertex whose whole 1-ring moved rigidly seeds a group. The group grows over neighbours
        that follow its motion, and the motion is fitted again, until neither changes.
        """
        errors, reach = self._rings.largest, tolerance * self.mesh.diagonal
        waiting = errors <= reach
        taken = np.zeros(len(errors), bool)
        groups = []
        for seed in np.argsort(errors, kind="stable"):
            if not waiting[seed]:
                continue
            group = _grow(self.mesh.vertices, self._poses, self._graph, seed, reach, ~taken)
            waiting[seed] = False
            if group is not None:
                waiting[group.vertices] = False
                taken[group.vertices] = True
                groups.append(group)
        return tuple(sorted(groups, key=lambda group: -len(group.vertices)))


class _Motion(NamedTuple):
    """``p -> R p + t`` in each pose."""

    rotations: Float[np.ndarray, "poses 3 3"]
    translations: Float[np.ndarray, "poses 3"]

    def distances(self, p, q) -> Float[np.ndarray, "members"]:
        """Return how far each vertex at most is from where the motion puts it, over the poses."""
        moved = p @ np.swapaxes(self.rotations, 1, 2) + self.translations[:, None]
        return np.linalg.norm(moved - q, axis=2).max(axis=0)


def _best_motion(
    p: Float[np.ndarray, "members 3"], q: Float[np.ndarray, "poses members 3"]
) -> _Motion:
    middle, moved = p.mean(axis=0), q.mean(axis=1)
    rotation = _rotations(np.einsum("ka,pkb->pba", p - middle, q - moved[:, None]))
    return _Motion(rotation, moved - rotation @ middle)


def _rotations(covariance: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Return the proper rotation nearest to each matrix (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(covariance)
    flip = np.ones(covariance.shape[:-1])
    flip[..., 2] = np.linalg.det(u @ vt)
    return (u * flip[..., None, :]) @ vt


class _RingErrors(NamedTuple):
    """How far each 1-ring is from moving rigidly; infinite for fewer than two neighbours."""

    largest: Float[np.ndarray, "vertices"]
    """Distance of the vertex that is farthest off, over the poses."""
    mean: Float[np.ndarray, "vertices"]
    """Root mean square of a coordinate, per degree of freedom, of the worst pose."""


def _ring_errors(p, poses, graph: sp.csr_matrix) -> _RingErrors:
    n = len(p)
    ring = sp.csr_matrix(graph + sp.identity(n, format="csr"))
    count = np.diff(ring.indptr)
    row, column = np.repeat(np.arange(n), count), ring.indices
    edge = p[column] - p[row]
    largest, squares = np.zeros(n), np.zeros(n)
    for q in poses:
        moved = q[column] - q[row]
        mean = [summed(x, row, n) / count[:, None] for x in (edge, moved)]
        a, b = edge - mean[0][row], moved - mean[1][row]
        rotation = _rotations(
            summed((b[:, :, None] * a[:, None, :]).reshape(-1, 9), row, n).reshape(n, 3, 3)
        )
        off = np.linalg.norm(np.einsum("eij,ej->ei", rotation[row], a) - b, axis=1)
        np.maximum.at(largest, row, off)
        squares = np.maximum(squares, np.bincount(row, off**2, n))
    enough = count > 2
    freedom = np.where(enough, 3 * count - 6, 1)
    return _RingErrors(*np.where(enough, [largest, np.sqrt(squares / freedom)], np.inf))


def _grow(p, poses, graph, seed: int | np.integer, reach: float, allowed) -> RigidGroup | None:
    """Grow a group from the 1-ring of its seed; None if the group loses that ring."""
    ring = np.append(_neighbours(graph, np.array([seed])), seed)
    members = ring
    for _ in range(_GROWTHS):
        motion = _best_motion(p[members], poses[:, members])
        grown = _followers(p, poses, graph, seed, members, motion, reach, allowed)
        if not np.isin(ring, grown).all():
            return None
        if np.array_equal(grown, members):
            break
        members = grown
    motion = _best_motion(p[members], poses[:, members])
    error = motion.distances(p[members], poses[:, members]).max()
    return RigidGroup(members, *motion, float(error))


def _followers(
    p, poses, graph, seed: int | np.integer, members, motion: _Motion, reach: float, allowed
) -> Int[np.ndarray, "followers"]:
    """Return the vertices that follow the motion and are connected with the seed, ascending.

    From the members outwards, so that a group costs by its own size, not by that of the mesh.
    """
    found, seen, front = [], np.zeros(len(p), bool), members
    while front.size:
        seen[front] = True
        follow = allowed[front] & (motion.distances(p[front], poses[:, front]) <= reach)
        found.append(front[follow])
        around = np.unique(_neighbours(graph, found[-1]))
        front = around[~seen[around]]
    followers = np.sort(np.concatenate(found))
    if len(found[0]) == len(members):  # connected, as the members were
        return followers
    _, label = sp.csgraph.connected_components(graph[followers][:, followers], directed=False)
    at = np.searchsorted(followers, seed)
    if at == len(followers) or followers[at] != seed:
        return followers[:0]
    return followers[label == label[at]]


def _neighbours(
    graph: sp.csr_matrix, rows: Int[np.ndarray, "rows"]
) -> Int[np.ndarray, "neighbours"]:
    """Return the columns of the rows, one row after the other (a sixth of the time of scipy's)."""
    first = graph.indptr[rows]
    count = graph.indptr[rows + 1] - first
    ends = np.cumsum(count)
    return graph.indices[np.repeat(first - ends + count, count) + np.arange(count.sum())]
