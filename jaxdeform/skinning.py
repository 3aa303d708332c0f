"""Skinning: transformations of a few controls, blended by weights (thesis chapter 3, first part).

    p'_i = sum_j w_ij T_j p_i

Controls are points, bones or a cage. Weights are (n, m), one row per vertex, and sum to one.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import igl
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxdeform.handles import (
    as_array,
    check_components,
    check_groups,
    check_handles,
    check_positions,
    known,
)
from jaxdeform.mesh import InputError, Mesh
from jaxdeform.shapes import rotation_matrices

# How far a row of weights may be from one in sum, and R^T R of a rigid matrix from I: what single
# precision and text files with six digits leave.
_LOOSE = 1e-5

# ---------------------------------------------------------------- skeletons


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints and the bones between them. Read by :func:`load_skeleton`."""

    joints: Float[np.ndarray, "j 3"]
    bones: Int[np.ndarray, "m 2"]
    """The two joints of each bone."""

    @property
    def segments(self) -> Float[np.ndarray, "m 2 3"]:
        """Both ends of each bone: the controls that the weights are made of."""
        return self.joints[self.bones]

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        return f"Skeleton({len(self.joints)} joints, {len(self.bones)} bones)"


def load_skeleton(path: str | os.PathLike) -> Skeleton:
    """Read a skeleton from a ``.tgf`` file (the graphs of Jacobson et al.'s skinning programs).

    Lines ``number x y z`` with the joints, numbered from 1; a line ``#``; lines ``i j`` with the
    edges, which may go on with three flags (bone, pseudo, cage). Without flags an edge is a bone.

    **Returns** a :class:`Skeleton` of all joints, and of the edges that are bones.

    **Raises** InputError naming the file and the line; also for a bone of length zero and for a
    file without bones.

    Example:
        >>> import jaxdeform as jd, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "arm.tgf"
        >>> _ = path.write_text("1 0 0 0\\n2 0 1 0\\n3 0 2 0\\n#\\n1 2\\n2 3\\n")
        >>> jd.load_skeleton(path)
        Skeleton(3 joints, 2 bones)
    """
    path = Path(path)
    if path.suffix.lower() != ".tgf":
        raise InputError(f"{path}: skeletons are .tgf files, not '{path.suffix}'")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}): check the name") from error
    joints: list[list[float]] = []
    bones: list[list[int]] = []
    part = 0
    for number, words in enumerate((line.split() for line in lines), start=1):
        where = f"{path}, line {number}"
        if words[:1] == ["#"]:
            part += 1
        elif words and part == 0:
            joints.append(_joint(where, words, len(joints) + 1))
        elif words and part == 1:
            i, j, *flags = _edge(where, words, len(joints))
            if not flags or flags[0]:
                if joints[i] == joints[j]:
                    raise InputError(f"{where}: the bone from {i + 1} to {j + 1} has length zero")
                bones.append([i, j])
    if not bones:
        raise InputError(f"{path}: has {len(joints)} joints and no bones: is the line '#' missing?")
    return Skeleton(np.array(joints), np.array(bones))


def _joint(where: str, words: list[str], expected: int) -> list[float]:
    try:
        number, position = int(words[0]), [float(word) for word in words[1:]]
    except ValueError:
        raise InputError(f"{where}: '{' '.join(words)}' is no joint 'number x y z'") from None
    if number != expected or len(position) != 3 or not np.isfinite(position).all():
        raise InputError(f"{where}: expected joint {expected} as '{expected} x y z'")
    return position


def _edge(where: str, words: list[str], count: int) -> list[int]:
    try:
        i, j, *flags = (int(word) for word in words)
    except ValueError:
        raise InputError(f"{where}: '{' '.join(words)}' is no edge 'i j'") from None
    if not (1 <= i <= count and 1 <= j <= count):
        raise InputError(f"{where}: edge {i} {j} names a joint out of range 1 to {count}")
    return [i - 1, j - 1, *flags]


# ---------------------------------------------------------------- weights


def rigid_weights(
    vertices: ArrayLike, controls: ArrayLike, *, distances: ArrayLike | None = None
) -> Float[Array, "n m"]:
    """Return weight 1 for the nearest control and 0 for the others (thesis chapter 3).

    Of controls equally near, the first takes all, so that the weights sum to one.

    **Arguments** as in :func:`inverse_distance_weights`, but for the power.

    **Raises** InputError as there.

    Example:
        >>> import jaxdeform as jd
        >>> jd.rigid_weights([[0.0, 1.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]).tolist()
        [[1.0, 0.0]]
    """
    squares = _squares(vertices, controls, distances)
    return jax.nn.one_hot(jnp.argmin(squares, axis=1), squares.shape[1], dtype=squares.dtype)


def inverse_distance_weights(
    vertices: ArrayLike,
    controls: ArrayLike,
    power: ArrayLike = 2.0,
    *,
    distances: ArrayLike | None = None,
) -> Float[Array, "n m"]:
    """Return weights proportional to ``1 / distance^power``, with sum one (thesis chapter 3).

    A vertex on a control belongs to it alone (in equal parts to all that it lies on). Traceable,
    and differentiable to all arguments.

    **Arguments**

    - vertices: (n, 3).
    - controls: points (m, 3), or bones (m, 2, 3), whose distance is that of the segment.
    - power: a number > 0; the larger, the closer to :func:`rigid_weights`.
    - distances: (n, m), used instead of the Euclidean ones, as from :func:`geodesic_distances`.

    **Raises** InputError: wrong shapes; values that are not finite; a bone of length zero; a power
    of 0 or less; a vertex at infinite distance from every control.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> ends = [[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
        >>> weights = jd.inverse_distance_weights([[0.0, 1.0, 0.0]], ends)
        >>> np.allclose(weights, [[0.9, 0.1]])
        True
    """
    squares = _squares(vertices, controls, distances)
    power = as_array(power, squares.dtype, "power")
    if power.ndim or (known(power) and not (0 < float(power) < np.inf)):
        raise InputError(f"power is {power}: give one finite number above 0")
    on = squares == 0
    # A softmax of logarithms, because 1 / d^power overflows for small d.
    logits = -0.5 * power * jnp.log(jnp.where(on, 1.0, squares))
    hits = jnp.sum(on, axis=1, keepdims=True, dtype=squares.dtype)
    alone = on.astype(squares.dtype) / jnp.maximum(hits, 1.0)
    return jnp.where(hits > 0, alone, jax.nn.softmax(logits, axis=1))


def geodesic_distances(mesh: Mesh, sources: ArrayLike) -> Float[np.ndarray, "n m"]:
    """Return the distance along the surface from every vertex to each of m vertices.

    Exact on the polyhedron (Mitchell et al. 1987; libigl). Infinite between parts of the mesh that
    are not connected. On a cactus of 5,300 vertices a source takes 0.7 s.

    **Arguments**: mesh; sources (m,) vertex indices.

    **Raises** InputError: a source out of range or repeated; a mesh with an edge of more than two
    faces, or whose surfaces meet in a single vertex (libigl would crash or return zeros).

    Example:
        >>> import jaxdeform as jd
        >>> jd.geodesic_distances(jd.shapes.square(), [4])[0].round(6).tolist()
        [1.414214]
    """
    index = check_handles(sources, mesh.n_vertices)
    faces = np.ascontiguousarray(mesh.faces)
    used = np.unique(faces)
    if not (igl.is_edge_manifold(faces)[0] and np.ravel(igl.is_vertex_manifold(faces))[used].all()):
        raise InputError("geodesic distances need a manifold surface: see jd.inspect(mesh)")
    i, j = mesh.edges.T
    graph = sp.coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(mesh.n_vertices,) * 2)
    _, label = sp.csgraph.connected_components(graph, directed=False)
    out = np.full((mesh.n_vertices, len(index)), np.inf)
    none = np.array([], np.int64)
    for k, source in enumerate(index):
        # libigl says 0 where there is no way, so only those with one are asked for.
        reached = np.flatnonzero(label == label[source])
        if len(reached) > 1:
            out[reached, k] = igl.exact_geodesic(
                mesh.vertices, faces, np.array([source]), none, reached, none
            )
        out[source, k] = 0.0
    return out


def bounded_biharmonic_weights(
    mesh: Mesh, handles: ArrayLike, group: ArrayLike | None = None
) -> Float[Array, "n m"]:
    """Return bounded biharmonic weights (Jacobson et al. 2011) on the surface of a mesh.

    ``w_j`` minimises ``integral |Laplacian w_j|^2`` with ``0 <= w_j <= 1``, 1 on its own handles
    and 0 on those of the others; the rows are then divided by their sums, which are near one. They
    are smooth and follow the shape. The paper solves them in the volume; here the domain is the
    surface, so controls are vertices of it.

    **Arguments**

    - mesh: the surface, closed or open.
    - handles: (h,) vertex indices.
    - group: (h,) the control that each handle belongs to, 0 to m - 1; each its own if left out.

    **Raises** InputError: a handle out of range or repeated; a group without handles; a connected
    part without handles; unreferenced vertices (all of which crash libigl or come out as NaN).

    Example:
        >>> import jaxdeform as jd
        >>> jd.bounded_biharmonic_weights(jd.shapes.bar(), [0, 721]).shape
        (722, 2)
    """
    index = check_handles(handles, mesh.n_vertices)
    group = np.arange(len(index)) if group is None else check_groups(group, len(index))
    count = int(group.max()) + 1
    empty = np.setdiff1d(np.arange(count), group)
    if empty.size:
        raise InputError(f"group {empty[0]} has no handles: number the groups 0 to m - 1")
    referenced = np.zeros(mesh.n_vertices, bool)
    referenced[mesh.faces.ravel()] = True
    if not referenced.all():
        raise InputError(
            f"vertex {np.flatnonzero(~referenced)[0]} belongs to no face, so no weight reaches "
            "it: drop such vertices with jd.repair(mesh)"
        )
    check_components(mesh, index, referenced)
    # To unit size, because libigl's tolerances are absolute.
    points = mesh.vertices - mesh.vertices.mean(axis=0)
    points = points / np.abs(points).max()
    weights = igl.bbw(points, np.ascontiguousarray(mesh.faces), index, np.eye(count)[group])
    weights = np.clip(weights, 0.0, 1.0)
    total = weights.sum(axis=1, keepdims=True)
    if not np.isfinite(total).all() or total.min() < 0.1:
        raise InputError(
            "the biharmonic system could not be solved: the mesh has triangles too thin for it; "
            "see jd.inspect(mesh)"
        )
    return jnp.asarray(weights / total, jnp.result_type(float))


def mean_value_coordinates(vertices: ArrayLike, cage: Mesh) -> Float[Array, "n m"]:
    """Return mean value coordinates of points in a closed cage (Ju, Schaefer and Warren 2005).

    They reproduce linear functions: rows sum to one and ``weights @ cage.vertices`` is the point.
    A cage deformation is therefore ``weights @ deformed_cage_vertices``. Smooth inside, linear on
    the cage's faces; negative for points that do not see the whole cage, if it is not convex.
    (libigl's ``mvc`` is for polygons: it returns NaN for a cage in space.)

    **Arguments**: vertices (n, 3), in the cage or on it; cage, a closed mesh of m vertices.

    **Raises** InputError: an open cage; a point outside of it.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> cage = jd.shapes.bar()
        >>> weights = jd.mean_value_coordinates([[1.0, 60.0, 2.0]], cage)
        >>> np.allclose(weights @ cage.vertices, [[1.0, 60.0, 2.0]])
        True
    """
    points = np.asarray(vertices, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"vertices have shape {points.shape}: give (n, 3) finite positions")
    _check_cage(points, cage)
    faces, corners = cage.faces, cage.vertices
    out = np.empty((len(points), len(corners)))
    # So many points at a time that the arrays per point and face stay within 100 MB.
    step = max(1, 100_000 // len(faces))
    for first in range(0, len(points), step):
        some = slice(first, first + step)
        out[some] = _mean_values(points[some], corners, faces)
    return jnp.asarray(out, jnp.result_type(float))


def _check_cage(points: Float[np.ndarray, "n 3"], cage: Mesh) -> None:
    # Each edge of a closed surface is run along as often in one direction as in the other.
    sides = cage.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, place = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    balance = np.bincount(place.ravel(), np.where(sides[:, 0] < sides[:, 1], 1, -1))
    if balance.any():
        i, j = edges[np.flatnonzero(balance)[0]]
        raise InputError(
            f"the cage is open, or its faces are turned against each other, at the edge ({i}, "
            f"{j}): give a closed mesh"
        )
    faces = np.ascontiguousarray(cage.faces)
    inside = np.abs(igl.winding_number(cage.vertices, faces, points)) > 0.5
    # On the cage itself the winding number is 1/2 give or take.
    square, _, _ = igl.point_mesh_squared_distance(points, cage.vertices, faces)
    near = np.sqrt(np.ravel(square)) < 1e-9 * np.ptp(cage.vertices, axis=0).max()
    outside = np.flatnonzero(~(inside | near))
    if outside.size:
        raise InputError(
            f"vertex {outside[0]} {points[outside[0]].tolist()} is outside the cage "
            f"({outside.size} such): enlarge the cage"
        )


def _mean_values(points, corners, faces) -> Float[np.ndarray, "n m"]:
    """Return the coordinates of points that may lie anywhere (Ju et al. 2005, Sec. 3).

    Seen from a point, each face is a spherical triangle with the mean normal
    ``m = sum_i theta_i n_i / 2``, where n_i is the unit normal of the plane through the point and
    the side opposite to corner i. Its weights solve ``m = sum_i w_i (corner_i - point)``.
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
    # In the plane of a face but outside of it, the face is an arc and weighs nothing.
    flat = (np.abs(height) < 1e-9).any(axis=2, keepdims=True)
    shares = np.einsum("pfix,pfx->pfi", normal, mean) / np.where(flat, np.inf, height)
    shares /= np.where(on_corner, 1.0, length)[:, faces]
    # On a face its barycentric coordinates are the limit; a corner takes all.
    on_face = flat[:, :, 0] & (theta.sum(axis=2) > 2.0 * np.pi - 1e-9)
    reach = length[:, faces]
    area = sine * np.roll(reach, -1, axis=2) * np.roll(reach, -2, axis=2)
    shares = np.where(on_face.any(axis=1)[:, None, None], on_face[:, :, None] * area, shares)
    to_corner = sp.csr_matrix(
        (np.ones(faces.size), (np.arange(faces.size), faces.ravel())), (faces.size, len(corners))
    )
    total = shares.reshape(len(points), -1) @ to_corner
    total = np.where(on_corner.any(axis=1, keepdims=True), on_corner, total)
    return total / total.sum(axis=1, keepdims=True)


# ---------------------------------------------------------------- transformations


def rigid_transforms(
    rotations: ArrayLike, translations: ArrayLike, centers: ArrayLike
) -> Float[Array, "m 3 4"]:
    """Return the matrices of ``p -> R (p - center) + center + t``, one per control.

    **Arguments**: rotations (m, 3), rotation vectors (their length is the angle in radians);
    translations (m, 3); centers (m, 3). **Raises** InputError: shapes that differ.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> turn = jd.rigid_transforms([[0, 0, np.pi]], [[0, 0, 0]], [[1, 0, 0]])
        >>> np.allclose(turn[0, :, 3], [2.0, 0.0, 0.0], atol=1e-6)
        True
    """
    dtype = jnp.result_type(float)
    rotations = as_array(rotations, dtype, "rotations")
    if rotations.ndim != 2 or rotations.shape[1] != 3:
        raise InputError(f"rotations have shape {rotations.shape}: give (m, 3) rotation vectors")
    shape = rotations.shape
    rotations = check_positions("rotations", rotations, shape, dtype, unit="control")
    translations = check_positions("translations", translations, shape, dtype, unit="control")
    centers = check_positions("centers", centers, shape, dtype, unit="control")
    turn = rotation_matrices(rotations)
    shift = centers + translations - jnp.einsum("mij,mj->mi", turn, centers, precision="highest")
    return jnp.concatenate([turn, shift[:, :, None]], axis=2)


def linear_blend_skinning(
    vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike
) -> Float[Array, "n 3"]:
    """Return ``p'_i = sum_j w_ij T_j p_i`` (thesis chapter 3).

    Affine transformations are blended as matrices, so the blend of two rotations shrinks: a twist
    of 180 degrees collapses the middle. See :func:`dual_quaternion_skinning`. A pure function of
    arrays: jit, vmap (over poses), grad and jvp to all arguments.

    **Arguments**

    - vertices: (n, 3).
    - weights: (n, m), rows with sum one.
    - transforms: (m, 3, 4), the matrix and the shift of each control.

    **Raises** InputError: shapes that do not fit; a row of weights whose sum is not one; values
    that are not finite. Values are checked when they are known, shapes also while tracing.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> moves = jd.rigid_transforms(np.zeros((2, 3)), [[0, 0, 0], [0, 4, 0]], np.zeros((2, 3)))
        >>> jd.linear_blend_skinning([[1.0, 0.0, 0.0]], [[0.75, 0.25]], moves).tolist()
        [[1.0, 1.0, 0.0]]
    """
    vertices, weights, transforms = _checked_skin(vertices, weights, transforms)
    blend = jnp.einsum("nm,mij->nij", weights, transforms, precision="highest")
    return _apply(blend[:, :, :3], blend[:, :, 3], vertices)


def dual_quaternion_skinning(
    vertices: ArrayLike, weights: ArrayLike, transforms: ArrayLike
) -> Float[Array, "n 3"]:
    """Blend rigid transformations as unit dual quaternions (Kavan et al. 2008).

    The blend of rigid motions is a rigid motion, so nothing shrinks. Of the two quaternions of a
    rotation, each is taken that lies on the side of the vertex's heaviest control: the shorter way
    round. Where two controls differ by exactly 180 degrees there is none, and the result jumps;
    everywhere else it is smooth. Transformable as :func:`linear_blend_skinning`.

    **Arguments** as there; weights >= 0, transforms rigid (rotation and shift).

    **Raises** InputError as there; also for negative weights and a matrix that is no rotation.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> zero = np.zeros((2, 3))
        >>> turn = jd.rigid_transforms([[0, 0, 0], [0, 0, np.pi / 2]], zero, zero)
        >>> point = jd.dual_quaternion_skinning([[1.0, 0.0, 0.0]], [[0.5, 0.5]], turn)
        >>> bool(abs(np.linalg.norm(point) - 1) < 1e-6)
        True
    """
    vertices, weights, transforms = _checked_skin(vertices, weights, transforms)
    _check_blendable(weights, transforms)
    real = _quaternions(transforms[:, :, :3])
    shift = jnp.concatenate([jnp.zeros_like(real[:, :1]), transforms[:, :, 3]], axis=1)
    dual = 0.5 * _product(shift, real)
    # Both signs are the same rotation: the one nearer to the heaviest control's.
    nearness = jnp.matmul(real, real.T, precision="highest")
    side = jnp.where(nearness < 0.0, -1.0, 1.0).astype(real.dtype)
    signed = weights * side[jnp.argmax(weights, axis=1)]
    real, dual = (jnp.matmul(signed, q, precision="highest") for q in (real, dual))
    length = jnp.linalg.norm(real, axis=1, keepdims=True)
    real, dual = real / length, dual / length
    conjugate = real * jnp.asarray([1.0, -1.0, -1.0, -1.0], real.dtype)[None]
    return _apply(_matrices(real), 2.0 * _product(dual, conjugate)[:, 1:], vertices)


def _apply(turn, shift, vertices) -> Float[Array, "n 3"]:
    return jnp.einsum("nij,nj->ni", turn, vertices, precision="highest") + shift


def _quaternions(turn: Float[Array, "m 3 3"]) -> Float[Array, "m 4"]:
    """Return (w, x, y, z) of rotation matrices, in either sign.

    ``4 q q^T`` is linear in the matrix. Its row with the largest diagonal entry is q times a
    number that is at least 1, hence smooth to differentiate, the identity and 180 degrees included.
    """
    (a, b, c), (d, e, f), (g, h, i) = jnp.moveaxis(turn, 0, -1)
    outer = jnp.stack(
        [
            jnp.stack([1 + a + e + i, h - f, c - g, d - b], axis=1),
            jnp.stack([h - f, 1 + a - e - i, b + d, c + g], axis=1),
            jnp.stack([c - g, b + d, 1 - a + e - i, f + h], axis=1),
            jnp.stack([d - b, c + g, f + h, 1 - a - e + i], axis=1),
        ],
        axis=1,
    )
    largest = jnp.argmax(jnp.diagonal(outer, axis1=1, axis2=2), axis=1)
    row = jnp.take_along_axis(outer, largest[:, None, None], axis=1)[:, 0]
    return row / jnp.linalg.norm(row, axis=1, keepdims=True)


def _matrices(q: Float[Array, "n 4"]) -> Float[Array, "n 3 3"]:
    w, x, y, z = q.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _product(p: Float[Array, "n 4"], q: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    (a, b, c, d), (w, x, y, z) = p.T, q.T
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=1,
    )


# ---------------------------------------------------------------- checks of the arguments


def _squares(vertices, controls, distances) -> Float[Array, "n m"]:
    """Squared distances from vertices to points or segments, or those that were given."""
    dtype = jnp.result_type(float)
    vertices = _rows_of_three("vertices", vertices, dtype)
    ends = as_array(controls, dtype, "controls")
    if ends.ndim not in (2, 3) or ends.shape[1:] not in ((3,), (2, 3)) or not len(ends):
        raise InputError(
            f"controls have shape {ends.shape}: give points (m, 3) or bones (m, 2, 3), m >= 1"
        )
    ends = check_positions("controls", ends, ends.shape, dtype, unit="control")
    n, m = len(vertices), len(ends)
    if distances is not None:
        return _given_squares(as_array(distances, dtype, "distances"), (n, m))
    if ends.ndim == 2:
        return jnp.sum((vertices[:, None] - ends[None]) ** 2, axis=2)
    along = ends[:, 1] - ends[:, 0]
    square = jnp.sum(along**2, axis=1)
    if known(square) and not np.asarray(square).all():
        raise InputError(
            f"bone {np.flatnonzero(np.asarray(square) == 0)[0]} has length zero: give two "
            "different ends, or points (m, 3)"
        )
    arm = vertices[:, None] - ends[None, :, 0]
    part = jnp.clip(
        jnp.einsum("nmi,mi->nm", arm, along / square[:, None], precision="highest"), 0.0, 1.0
    )
    return jnp.sum((arm - part[:, :, None] * along[None]) ** 2, axis=2)


def _given_squares(distances: Array, shape: tuple[int, int]) -> Float[Array, "n m"]:
    if distances.shape != shape:
        raise InputError(
            f"distances have shape {distances.shape}, expected {shape}: vertices by controls"
        )
    if known(distances):
        values = np.asarray(distances)
        bad = np.argwhere(~(values >= 0))
        if bad.size:
            i, j = bad[0]
            raise InputError(f"the distance of vertex {i} to control {j} is {values[i, j]}")
        far = np.flatnonzero(np.isinf(values).all(axis=1))
        if far.size:
            raise InputError(
                f"vertex {far[0]} is connected to no control: put one on its part of the mesh"
            )
    return distances**2


def _checked_skin(vertices, weights, transforms) -> tuple[Array, Array, Array]:
    dtype = jnp.result_type(float)
    vertices = _rows_of_three("vertices", vertices, dtype)
    weights = as_array(weights, dtype, "weights")
    if weights.ndim != 2 or len(weights) != len(vertices):
        raise InputError(
            f"weights have shape {weights.shape}: give ({len(vertices)}, m), vertices by controls"
        )
    weights = check_positions("weights", weights, weights.shape, dtype)
    if known(weights):
        total = np.asarray(weights).sum(axis=1)
        bad = np.flatnonzero(np.abs(total - 1.0) > _LOOSE)
        if bad.size:
            raise InputError(
                f"the weights of vertex {bad[0]} sum to {total[bad[0]]:.6g}, not to 1: divide each "
                "row by its sum"
            )
    shape = (weights.shape[1], 3, 4)
    return vertices, weights, check_positions("transforms", transforms, shape, dtype, "control")


def _check_blendable(weights: Array, transforms: Array) -> None:
    if known(weights):
        low = np.asarray(weights).min(axis=1, initial=0.0)
        bad = np.flatnonzero(low < -_LOOSE)
        if bad.size:
            raise InputError(
                f"a weight of vertex {bad[0]} is {low[bad[0]]:.6g}: dual quaternions blend between "
                "motions only; give weights of 0 or more, or use linear_blend_skinning"
            )
    if known(transforms):
        turn = np.asarray(transforms)[:, :, :3]
        gap = np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(axis=(1, 2))
        bad = np.flatnonzero((gap > _LOOSE) | (np.linalg.det(turn) < 0))
        if bad.size:
            raise InputError(
                f"the matrix of control {bad[0]} is no rotation (it stretches, shears or "
                "reflects): give rigid motions, or use linear_blend_skinning"
            )


def _rows_of_three(name: str, value: ArrayLike, dtype: np.dtype) -> Float[Array, "n 3"]:
    array = as_array(value, dtype, name)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} have shape {array.shape}: give (n, 3)")
    return check_positions(name, array, array.shape, dtype)
