"""Finding handles: connected groups of vertices that moved rigidly."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._checks import check_tolerance, check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._estimation.poses import read_poses
from jaxdeform._mesh.grouping import summed
from jaxdeform._mesh.mesh import LARGEST, Mesh

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


def find_handles(
    mesh: Mesh, deformed: ArrayLike, *, tolerance: float = 1e-6
) -> Int[np.ndarray, "handles"]:
    """Find the handles: the vertices of all groups of `find_handle_groups`.

    **Arguments, Raises**: as there. **Returns** their indices, ascending.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = ((mesh.vertices[:, 1] < 6) | (mesh.vertices[:, 1] > 145)).nonzero()[0]
        >>> problem = jd.precompute(mesh, handles)
        >>> out = jd.deform(problem, jd.bend(mesh.vertices[handles], 90.0), 1.0)
        >>> (jd.find_handles(mesh, out.vertices) == handles).all()
        np.True_
    """
    groups = find_handle_groups(mesh, deformed, tolerance=tolerance)
    return np.unique(np.concatenate([group.vertices for group in groups]))


def find_handle_groups(
    mesh: Mesh, deformed: ArrayLike, *, tolerance: float = 1e-6
) -> tuple[RigidGroup, ...]:
    """Find the connected groups of vertices that moved rigidly, and how they moved.

    The thesis takes the vertices where the best linear map of the 1-ring (Eq. 4.6) is the identity,
    which misses handles that were rotated. Here a vertex whose whole 1-ring moved rigidly seeds a
    group. The group grows over neighbors that follow its motion, and the motion is fitted again,
    until neither changes. Several poses are taken together: a group moves rigidly in each.

    Vertices that merely happen not to deform are found too; leave them out of the handles if you
    know better.

    **Arguments**

    - mesh: the rest shape.
    - deformed: (n, 3) or (poses, n, 3) positions.
    - tolerance: how far a vertex may be from the motion of its group, as a fraction of the bounding
      box diagonal. The default suits positions stored as float32. With noise, take five times its
      standard deviation (among a hundred vertices one seldom is farther off).

    **Returns** the groups, the largest first.

    **Raises** InputError: shapes that do not fit, positions that are not finite, no group found.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> (group,) = jd.find_handle_groups(mesh, mesh.vertices + 1.0)
        >>> len(group.vertices), group.degrees.round(6)
        (722, array([0.]))
    """
    check_type("mesh", mesh, Mesh)
    n = mesh.n_vertices
    poses = _check_deformed(deformed, n)
    check_tolerance("tolerance", tolerance, positive=True)
    reach = tolerance * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    i, j = mesh.edges.T
    ones = np.ones(len(i), np.int8)
    graph = sp.csr_matrix(
        sp.coo_matrix((ones, (i, j)), (n, n)) + sp.coo_matrix((ones, (j, i)), (n, n))
    )
    error = _ring_errors(mesh.vertices, poses, graph)
    waiting = error <= reach
    taken = np.zeros(n, bool)
    groups = []
    for seed in np.argsort(error, kind="stable"):
        if not waiting[seed]:
            continue
        group = _grow(mesh.vertices, poses, graph, seed, reach, ~taken)
        waiting[seed] = False
        if group is not None:
            waiting[group.vertices] = False
            taken[group.vertices] = True
            groups.append(group)
    if not groups:
        raise InputError(
            "no handles found: nowhere did a vertex and its neighbors move rigidly within "
            f"{reach:.3g}; raise the tolerance ({tolerance:g} of the diagonal) to about five times "
            "the noise, or name the handles yourself"
        )
    return tuple(sorted(groups, key=lambda group: -len(group.vertices)))


def _check_deformed(deformed: ArrayLike, n: int) -> Float[np.ndarray, "poses vertices 3"]:
    poses = read_poses("deformed", deformed, n, np.dtype(np.float64))
    bad = np.argwhere(~(np.abs(poses) <= LARGEST).all(axis=2))
    if len(bad):
        pose, vertex = bad[0]
        raise InputError(
            f"deformed: vertex {vertex} of pose {pose} is {poses[pose, vertex].tolist()}: give "
            f"finite positions, up to {LARGEST:g}"
        )
    return poses


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


def _ring_errors(p, poses, graph: sp.csr_matrix) -> Float[np.ndarray, "vertices"]:
    """Return how far each 1-ring is from moving rigidly; infinite for fewer than two neighbors."""
    n = len(p)
    ring = sp.csr_matrix(graph + sp.identity(n, format="csr"))
    count = np.diff(ring.indptr)
    row, column = np.repeat(np.arange(n), count), ring.indices
    edge = p[column] - p[row]
    error = np.zeros(n)
    for q in poses:
        moved = q[column] - q[row]
        mean = [summed(x, row, n) / count[:, None] for x in (edge, moved)]
        a, b = edge - mean[0][row], moved - mean[1][row]
        rotation = _rotations(
            summed((b[:, :, None] * a[:, None, :]).reshape(-1, 9), row, n).reshape(n, 3, 3)
        )
        off = np.linalg.norm(np.einsum("eij,ej->ei", rotation[row], a) - b, axis=1)
        np.maximum.at(error, row, off)
    return np.where(count > 2, error, np.inf)


def _grow(p, poses, graph, seed: int | np.integer, reach: float, allowed) -> RigidGroup | None:
    """Grow a group from the 1-ring of its seed; None if the group loses that ring."""
    ring = np.append(graph[[seed]].indices, seed)
    members = ring
    for _ in range(_GROWTHS):
        motion = _best_motion(p[members], poses[:, members])
        follows = np.flatnonzero(allowed & (motion.distances(p, poses) <= reach))
        if not np.isin(ring, follows).all():
            return None
        _, label = sp.csgraph.connected_components(graph[follows][:, follows], directed=False)
        grown = follows[label == label[np.searchsorted(follows, seed)]]
        if np.array_equal(grown, members):
            break
        members = grown
    motion = _best_motion(p[members], poses[:, members])
    error = motion.distances(p[members], poses[:, members]).max()
    return RigidGroup(members, *motion, float(error))
