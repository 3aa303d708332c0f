"""Cage deformation by mean value coordinates (Ju, Schaefer and Warren 2005)."""

import igl
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from jaxdeform._checks import check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._values import read_host_rows


def mean_value_coordinates(vertices: ArrayLike, cage: Mesh) -> Float[Array, "vertices controls"]:
    """Return the mean value coordinates of points in a closed cage.

    The coordinates reproduce linear functions: each row sums to one, and
    ``weights @ cage.vertices`` is the point itself. ``weights @ deformed_cage_vertices`` therefore
    deforms the points with the cage. The coordinates are smooth inside and linear on the faces of
    the cage. In a cage that is not convex, they may be negative at points that do not see all of
    it. (libigl's ``mvc`` is for polygons in the plane: it returns NaN for a cage in space.)

    Ju, Schaefer and Warren, "Mean value coordinates for closed triangular meshes" (2005),
    doi:10.1145/1073204.1073229.

    **Arguments**

    - vertices: (vertices, 3), inside the cage or on it.
    - cage: a closed mesh, whose vertices are the controls.

    **Returns** (vertices, controls) weights.

    **Raises** InputError: the cage has faces without area; it is open or its faces are not
    oriented alike; a point is outside the cage or not finite.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> cage = jd.shapes.bar()
        >>> weights = jd.mean_value_coordinates([[1.0, 60.0, 2.0]], cage)
        >>> np.allclose(weights @ cage.vertices, [[1.0, 60.0, 2.0]])
        True
    """
    check_type("cage", cage, Mesh)
    points = read_host_rows("vertices", vertices)
    if len(cage.solid_faces) < cage.n_faces:
        raise InputError("the cage has faces without area: drop them with jd.repair(cage)")
    _check_cage(points, cage)
    faces, corners = cage.faces, cage.vertices
    out = np.empty((len(points), len(corners)))
    # Take as many points at a time as keep the arrays per point and face within 100 MB.
    step = max(1, 100_000 // len(faces))
    for first in range(0, len(points), step):
        some = slice(first, first + step)
        out[some] = _mean_values(points[some], corners, faces)
    return jnp.asarray(out, jnp.result_type(float))


def _check_cage(points: Float[np.ndarray, "vertices 3"], cage: Mesh) -> None:
    # In a closed surface, the faces traverse each edge equally often in both directions.
    sides = cage.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, place = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    balance = np.bincount(place.ravel(), np.where(sides[:, 0] < sides[:, 1], 1, -1))
    if balance.any():
        i, j = edges[np.flatnonzero(balance)[0]]
        raise InputError(
            f"the cage is open, or its faces are oriented against each other, at the edge ({i}, "
            f"{j}): give a closed mesh"
        )
    faces = np.ascontiguousarray(cage.faces)
    inside = np.abs(igl.winding_number(cage.vertices, faces, points)) > 0.5
    # On the cage itself the winding number is about 1/2, on either side of it.
    square, _, _ = igl.point_mesh_squared_distance(points, cage.vertices, faces)
    near = np.sqrt(np.ravel(square)) < 1e-9 * np.ptp(cage.vertices, axis=0).max()
    outside = np.flatnonzero(~(inside | near))
    if outside.size:
        raise InputError(
            f"vertex {outside[0]} {points[outside[0]].tolist()} is outside the cage "
            f"({outside.size} in total): enlarge the cage"
        )


def _mean_values(points, corners, faces) -> Float[np.ndarray, "points controls"]:
    """Return the coordinates of points anywhere in the cage or on it (Ju et al. 2005, Sec. 3).

    Seen from a point, each face is a spherical triangle with the mean normal
    ``m = sum_i theta_i n_i / 2``, where n_i is the unit normal of the plane through the point and
    the side opposite corner i. Its weights solve ``m = sum_i w_i (corner_i - point)``.
    """
    arm = corners[None] - points[:, None]
    length = np.linalg.norm(arm, axis=2)
    on_corner = length < 1e-12 * np.abs(corners).max()
    unit = arm / np.where(on_corner, 1.0, length)[:, :, None]
    u = unit[:, faces]
    v, w = np.roll(u, -1, axis=2), np.roll(u, -2, axis=2)
    theta = 2.0 * np.arctan2(np.linalg.norm(v - w, axis=3), np.linalg.norm(v + w, axis=3))
    normal = np.cross(v, w)
    sine = np.linalg.norm(normal, axis=3)
    normal /= np.where(sine > 0, sine, 1.0)[..., None]
    mean = 0.5 * np.einsum("pfi,pfix->pfx", theta, normal)
    height = np.einsum("pfix,pfix->pfi", normal, u)
    # From a point in the plane of a face but outside the face, it looks like an arc: no weight.
    flat = (np.abs(height) < 1e-9).any(axis=2, keepdims=True)
    weights = np.einsum("pfix,pfx->pfi", normal, mean) / np.where(flat, np.inf, height)
    weights /= np.where(on_corner, 1.0, length)[:, faces]
    # On a face the limit is its barycentric coordinates; at a corner, all weight on that corner.
    on_face = flat[:, :, 0] & (theta.sum(axis=2) > 2.0 * np.pi - 1e-9)
    reach = length[:, faces]
    area = sine * np.roll(reach, -1, axis=2) * np.roll(reach, -2, axis=2)
    weights = np.where(on_face.any(axis=1)[:, None, None], on_face[:, :, None] * area, weights)
    to_corner = sp.csr_matrix(
        (np.ones(faces.size), (np.arange(faces.size), faces.ravel())), (faces.size, len(corners))
    )
    total = weights.reshape(len(points), -1) @ to_corner
    total = np.where(on_corner.any(axis=1, keepdims=True), on_corner, total)
    return total / total.sum(axis=1, keepdims=True)
