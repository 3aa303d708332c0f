"""Finding handles: vertices that moved rigidly, and how exactly they must have."""

import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._checks import check_tolerance, check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._estimation.poses import read_poses
from jaxdeform._estimation.rigid_groups import RigidGroup, RigidGroups
from jaxdeform._mesh.mesh import LARGEST, Mesh

# So many times the noise floor, about four standard deviations of the noise in one pose: of a
# thousand vertices that moved rigidly two are farther off. But at least so much of the diagonal
# (rounding of float32), and at most so much: then it is no noise.
_NOISES, _LEAST, _MOST = 7.0, 1e-6, 1e-2
# The handles are in doubt if twice the tolerance finds so many times more, or if so large a share
# of the edges that leave a group lead to another one while more than half of the mesh is handles.
# Measured on finger and plate of the tests. Right handles (noise up to 1e-4 of the diagonal): at
# most 1.05 and 0.02. Wrong ones (from 3e-4, 5e-4): one of the two from 1.22 or from 0.11.
_MORE, _TOUCHING = 1.2, 0.1


class FoundHandles(NamedTuple):
    """Groups of vertices that moved rigidly, and by which tolerance they were found."""

    groups: tuple[RigidGroup, ...]
    tolerance: float
    """A fraction of the diagonal."""
    doubt: str
    """Why another tolerance would find others; empty if none would, or if it was given."""

    @property
    def vertices(self) -> Int[np.ndarray, "handles"]:
        """Return the vertices of all groups, ascending."""
        return np.unique(np.concatenate([group.vertices for group in self.groups]))


def find_handles(
    mesh: Mesh, deformed: ArrayLike, *, tolerance: float | None = None
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
    return _undoubted(mesh, deformed, tolerance).vertices


def find_handle_groups(
    mesh: Mesh, deformed: ArrayLike, *, tolerance: float | None = None
) -> tuple[RigidGroup, ...]:
    """Find the connected groups of vertices that moved rigidly, and how they moved.

    The thesis takes the vertices where the best linear map of the 1-ring (Eq. 4.6) is the identity,
    which misses handles that were rotated. Here a vertex whose whole 1-ring moved rigidly seeds a
    group. The group grows over neighbours that follow its motion, and the motion is fitted again,
    until neither changes. Several poses are taken together: a group moves rigidly in each.

    Vertices that merely happen not to deform are found too; leave them out of the handles if you
    know better.

    **Arguments**

    - mesh: the rest shape.
    - deformed: (vertices, 3) or (poses, vertices, 3) positions.
    - tolerance: how far a vertex may be from the motion of its group, as a fraction of the bounding
      box diagonal. By default 1e-6 where twice that finds no others. Else about four standard
      deviations of the noise (more in many poses), taken from the 1-rings that moved most rigidly:
      one in 200, at least five. So handles must have that many; up to 1e-2.

    **Returns** the groups, the largest first. A warning tells if the noise decides which vertices
    are handles: if twice the default tolerance finds a fifth more, or if the groups touch and are
    more than half of the mesh. On fine meshes noise may hide that: look at the groups.

    **Raises** InputError: shapes that do not fit, positions that are not finite, no group found.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> (group,) = jd.find_handle_groups(mesh, mesh.vertices + 1.0)
        >>> len(group.vertices), group.degrees.round(6)
        (722, array([0.]))
    """
    return _undoubted(mesh, deformed, tolerance).groups


def _undoubted(mesh: Any, deformed: Any, tolerance: Any) -> FoundHandles:
    found = search_handles(mesh, deformed, tolerance)
    if found.doubt:
        warnings.warn(
            f"{found.doubt}: compare the estimates, or name the handles yourself", stacklevel=3
        )
    return found


def search_handles(mesh: Any, deformed: Any, tolerance: Any) -> FoundHandles:
    """Check the arguments of `find_handle_groups`, find the groups and say how."""
    check_type("mesh", mesh, Mesh)
    poses = _check_deformed(deformed, mesh.n_vertices)
    if tolerance is not None:
        check_tolerance("tolerance", tolerance, positive=True)
    search = RigidGroups(mesh, poses)
    if tolerance is not None:
        return FoundHandles(_groups_within(search, tolerance), tolerance, "")
    # Exact poses first: their noise floor is that of what bends where handles are few.
    exact = FoundHandles(search.within(_LEAST), _LEAST, "")
    if exact.groups and not _doubt(search, exact):
        return exact
    chosen = min(max(_NOISES * search.noise_floor(), _LEAST), _MOST)
    found = FoundHandles(_groups_within(search, chosen), chosen, "")
    return found._replace(doubt=_doubt(search, found))


def _groups_within(search: RigidGroups, tolerance: float) -> tuple[RigidGroup, ...]:
    groups = search.within(tolerance)
    if not groups:
        raise InputError(
            "no handles found: nowhere did a vertex and its neighbours move rigidly within "
            f"{tolerance * search.mesh.diagonal:.3g} ({tolerance:.3g} of the diagonal); raise the "
            "tolerance to about four times the noise, or name the handles yourself. Where nothing "
            "is rigid, as in a face, take each fifteenth vertex or so, with precompute(..., "
            "handle_weights=10.0), for a rough estimate"
        )
    return groups


def _doubt(search: RigidGroups, found: FoundHandles) -> str:
    """Say why the noise decides which vertices are handles, or nothing."""
    mesh, wider = search.mesh, search.within(2 * found.tolerance)
    count, more = (sum(len(x.vertices) for x in groups) for groups in (found.groups, wider))
    said = f"{count} vertices moved rigidly within {found.tolerance:.2g} of the diagonal"
    if more > _MORE * count:
        return f"{said}, {more} within twice that"
    if count > mesh.n_vertices / 2 and _touching(mesh, found.groups) > _TOUCHING:
        return f"{said}, but the {len(found.groups)} groups of them touch each other"
    return ""


def _touching(mesh: Mesh, groups: tuple[RigidGroup, ...]) -> float:
    """Return which share of the edges that leave a group lead to another one."""
    group = np.full(mesh.n_vertices, -1)
    for number, one in enumerate(groups):
        group[one.vertices] = number
    ends = group[mesh.edges]
    leaving = ends[ends[:, 0] != ends[:, 1]]
    return float((leaving >= 0).all(axis=1).mean()) if len(leaving) else 0.0


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
