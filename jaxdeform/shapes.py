"""Generated meshes to try things on, and makers of targets: translate, rotate, twist, bend."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._mesh.mesh import Mesh
from jaxdeform.errors import ArrayLike, InputError

# ---------------------------------------------------------------- meshes


def bar() -> Mesh:
    """Return the thesis's bar (Table 5.1): 722 vertices, 1440 faces, 30 x 151 x 30, along y.

    A closed box of 6 x 27 x 6 nearly square patches, each cut along its diagonal.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.bar()
        Mesh(722 vertices, 1440 faces)
    """
    counts, size = np.array([6, 27, 6]), np.array([30.0, 151.0, 30.0])
    points: dict[tuple[int, ...], int] = {}
    faces = []

    def index(*at: int) -> int:
        return points.setdefault(at, len(points))

    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, counts[axis]):
            for i in range(counts[u]):
                for j in range(counts[v]):
                    corner = []
                    for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        at = [0, 0, 0]
                        at[axis], at[u], at[v] = int(side), i + di, j + dj
                        corner.append(index(*at))
                    a, b, c, d = corner if side else corner[::-1]
                    faces += [(a, b, c), (a, c, d)]
    grid = np.array(list(points), dtype=np.float64)
    return Mesh(grid / counts * size - np.array([15.0, 0.0, 15.0]), faces)


def cylinder() -> Mesh:
    """Return a closed cylinder with 4802 vertices and 9600 faces, along y, as in the survey.

    120 rings of 40 vertices, of which the outer ten at each end shrink to a pole of valence 40.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.cylinder()
        Mesh(4802 vertices, 9600 faces)
    """
    around, caps, radius, height = 40, 10, 1.0, 12.0
    lids = radius * np.arange(1, caps + 1) / (caps + 1)
    wall = 120 - 2 * caps
    radii = np.concatenate([lids, np.full(wall, radius), lids[::-1]])
    heights = np.concatenate([np.zeros(caps), np.linspace(0, height, wall), np.full(caps, height)])
    angle = 2 * np.pi * np.arange(around) / around
    rings = np.stack(
        [
            radii[:, None] * np.cos(angle),
            np.broadcast_to(heights[:, None], (120, around)),
            radii[:, None] * np.sin(angle),
        ],
        axis=-1,
    )
    vertices = np.concatenate([[[0, 0, 0]], rings.reshape(-1, 3), [[0, height, 0]]])
    faces = []
    here, there = np.arange(around), np.roll(np.arange(around), -1)
    for ring in range(119):
        low, high = 1 + ring * around, 1 + (ring + 1) * around
        faces.append(np.stack([low + here, high + here, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, low + there], axis=1))
    last = 1 + 119 * around
    faces.append(np.stack([0 * here, 1 + here, 1 + there], axis=1))
    faces.append(np.stack([0 * here + last + around, last + there, last + here], axis=1))
    return Mesh(vertices, np.concatenate(faces))


def cactus() -> Mesh:
    """Return a cactus-like shape of about 5,300 vertices: a trunk with two bent arms, along y.

    Example:
        >>> import jaxdeform as jd
        >>> 5000 < jd.shapes.cactus().n_vertices < 5600
        True
    """
    limbs = [
        ([[0, 0, 0], [0, 2.2, 0], [0, 4.4, 0]], [0.62, 0.58, 0.5]),
        ([[0, 1.5, 0], [1.0, 1.6, 0], [1.45, 2.1, 0], [1.5, 3.3, 0]], [0.3, 0.3, 0.32, 0.28]),
        (
            [[0, 2.2, 0], [-0.9, 2.3, 0], [-1.3, 2.8, 0.1], [-1.35, 3.7, 0.1]],
            [0.28, 0.28, 0.3, 0.26],
        ),
    ]
    return _smooth_union(limbs, blend=0.18, vertices=5300)


def octopus(vertices: int = 50_000) -> Mesh:
    """Return an octopus-like shape: a head and eight curled tentacles, y upwards.

    **Arguments**: vertices, about how many it shall have (within 5 %).
    **Raises** InputError below 5,000: the tentacles would break off.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.octopus(10_000).n_vertices // 1000
        10
    """
    if isinstance(vertices, str) or vertices != int(vertices) or vertices < 5_000:
        raise InputError(f"octopus of {vertices} vertices: give a whole number, 5000 or more")
    limbs = [([[0, 0.4, 0], [0, 1.3, 0.1]], [0.72, 0.85])]
    for k in range(8):
        turn = 2 * np.pi * (k + 0.5) / 8
        s = np.linspace(0, 1, 14)
        out = 0.35 + 2.6 * s
        swing = turn + 0.5 * np.sin(2.4 * s)
        lift = -0.15 - 0.75 * np.sin(np.pi * 0.8 * s) + 0.9 * s**3
        path = np.stack([out * np.cos(swing), lift, out * np.sin(swing)], axis=1)
        limbs.append((path.tolist(), (0.27 - 0.18 * s).tolist()))
    return _smooth_union(limbs, blend=0.1, vertices=vertices)


def square() -> Mesh:
    """Return the 3 x 3 square of thesis Fig. 4.1: side 2, centre vertex (index 4) at the origin.

    Example:
        >>> import jaxdeform as jd
        >>> jd.shapes.square().vertices[4]
        array([0., 0., 0.])
    """
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(9)], axis=1)
    low = np.array([0, 1, 3, 4])
    faces = np.concatenate(
        [np.stack([low, low + 1, low + 4], 1), np.stack([low, low + 4, low + 3], 1)]
    )
    return Mesh(vertices, faces)


def _smooth_union(limbs, blend: float, vertices: int) -> Mesh:
    """Polygonise chains of round cones, melted together, to about the given number of vertices."""
    cones = [
        (np.array(a, float), np.array(b, float), ra, rb)
        for path, radii in limbs
        for (a, b), (ra, rb) in zip(pairwise(path), pairwise(radii), strict=True)
    ]
    ends = np.array([end for a, b, ra, rb in cones for end in (a - ra, a + ra, b - rb, b + rb)])
    low, high = ends.min(axis=0) - 2 * blend, ends.max(axis=0) + 2 * blend

    def polygonise(spacing: float) -> Mesh:
        from skimage.measure import marching_cubes  # slow to import, and only needed here

        axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
        field = _distance_on_grid(axes, cones, blend)
        points, faces, _, _ = marching_cubes(field, 0.0, allow_degenerate=False)
        points = np.asarray(points, np.float64) * spacing + low
        points, faces = _collapse_short_edges(points, np.asarray(faces, np.int64), 0.4 * spacing)
        return _relax(points, faces, cones, blend)

    spacing = 0.06
    for _ in range(4):
        mesh = polygonise(spacing)
        if abs(mesh.n_vertices / vertices - 1) < 0.04:
            break
        spacing *= np.sqrt(mesh.n_vertices / vertices)
    return mesh


def _distance_on_grid(axes, cones, blend: float) -> Float[np.ndarray, "x y z"]:
    """Evaluate the shape on a grid, each cone only in its own neighbourhood."""
    total = np.zeros([len(axis) for axis in axes])
    for a, b, ra, rb in cones:
        reach = max(ra, rb) + 8 * blend
        window = tuple(
            slice(*np.searchsorted(axis, [min(p, q) - reach, max(p, q) + reach]))
            for axis, p, q in zip(axes, a, b, strict=True)
        )
        x, y, z = np.meshgrid(
            *(axis[w] for axis, w in zip(axes, window, strict=True)), indexing="ij"
        )
        local = np.stack([x, y, z], axis=-1)
        total[window] += np.exp(-_cone(local, a, b, ra, rb) / (0.5 * blend))
    return -0.5 * blend * np.log(total + 1e-30)


def _cone(points, a, b, ra, rb):
    axis = b - a
    s = np.clip((points - a) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - a - s[..., None] * axis, axis=-1) - (ra + s * (rb - ra))


def _collapse_short_edges(points, faces, shortest: float):
    """Merge vertices closer than ``shortest``: marching cubes leaves slivers at clipped corners.

    Each vertex takes part in one merge at most, and only where the two share exactly two
    neighbours, which keeps the surface closed and manifold.
    """
    for _ in range(8):
        pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        pairs = np.unique(pairs, axis=0)
        length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
        short = pairs[np.argsort(length)][: int((length < shortest).sum())]
        if not len(short):
            break
        neighbours: list[set[int]] = [set() for _ in points]
        for i, j in pairs.tolist():
            neighbours[i].add(j)
            neighbours[j].add(i)
        target = np.arange(len(points))
        frozen: set[int] = set()
        for i, j in short.tolist():
            around = neighbours[i] | neighbours[j]
            shared = neighbours[i] & neighbours[j]
            if around & frozen or len(shared) != 2 or any(len(neighbours[k]) <= 4 for k in shared):
                continue
            frozen |= around
            points[i] = (points[i] + points[j]) / 2
            target[j] = i
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        used, flat = np.unique(faces, return_inverse=True)
        points, faces = points[used], flat.reshape(-1, 3)
        if (target == np.arange(len(target))).all():
            break
    return points, faces


def _relax(points, faces, cones, blend: float) -> Mesh:
    """Even out the triangles: move each vertex towards its neighbours, along the surface."""
    import scipy.sparse as sp

    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    graph = sp.coo_matrix((np.ones(ends.shape[1]), tuple(ends)), shape=(len(points),) * 2).tocsr()
    graph = sp.diags(1 / np.asarray(graph.sum(axis=1)).ravel()) @ graph
    for _ in range(12):
        a, b, c = (points[faces[:, k]] for k in range(3))
        face_normal = np.cross(b - a, c - a)
        normal = np.zeros_like(points)
        for k in range(3):
            np.add.at(normal, faces[:, k], face_normal)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        move = graph @ points - points
        points = points + 0.5 * (move - (move * normal).sum(axis=1, keepdims=True) * normal)
        points = points - normal * _distance(points, cones, blend)[:, None]
    a, b, c = (points[faces[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    return Mesh(points, faces if outward else faces[:, ::-1])


def _distance(points, cones, blend: float):
    total = np.full(len(points), 1e-30)
    for a, b, ra, rb in cones:
        reach = max(ra, rb) + 8 * blend
        near = ((points > np.minimum(a, b) - reach) & (points < np.maximum(a, b) + reach)).all(
            axis=1
        )
        total[near] += np.exp(-_cone(points[near], a, b, ra, rb) / (0.5 * blend))
    return -0.5 * blend * np.log(total)


# ---------------------------------------------------------------- targets


def translate(points: ArrayLike, offset: ArrayLike) -> Float[Array, "n 3"]:
    """Return the points moved by an offset (3,), or by one offset each (n, 3).

    **Raises** InputError: another shape.

    Example:
        >>> import jaxdeform as jd
        >>> jd.translate([[0.0, 0.0, 0.0]], [1.0, 2.0, 3.0]).tolist()
        [[1.0, 2.0, 3.0]]
    """
    points = _points(points)
    offset = _array("offset", offset, points.dtype, (3,), points.shape)
    return points + jnp.broadcast_to(offset, points.shape)


def rotate(
    points: ArrayLike,
    degrees: ArrayLike,
    *,
    axis: str | ArrayLike = "z",
    center: ArrayLike | None = None,
) -> Float[Array, "n 3"]:
    """Return the points turned about an axis through a centre (their centroid if left out).

    **Arguments**: points (n, 3); degrees, counter-clockwise seen against the axis; axis, 'x', 'y',
    'z' or a vector (3,); center (3,). **Raises** InputError: an axis of length zero, wrong shapes.

    Example:
        >>> import jaxdeform as jd
        >>> jd.rotate([[1.0, 0.0, 0.0]], 90.0, center=[0.0, 0.0, 0.0]).round(6).tolist()
        [[0.0, 1.0, 0.0]]
    """
    points = _points(points)
    center = _centroid(points) if center is None else center
    middle = _array("center", center, points.dtype, (3,))
    return _turn(points, _degrees(degrees, points), _axis(axis), middle)


def twist(points: ArrayLike, degrees: ArrayLike = 90.0, *, along: str = "y") -> Float[Array, "n 3"]:
    """Return the points with their upper half turned about the axis through their centroid.

    Meant for the handles at the two ends of a bar: one end stays, the other turns rigidly.

    **Arguments**: points (n, 3); degrees; along, the bar's axis. Halves are split in the middle.

    Example:
        >>> import jaxdeform as jd
        >>> jd.twist([[1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [-1.0, 2.0, 0.0]], 180.0).shape
        (3, 3)
    """
    points = _points(points)
    axis = _axis(along)
    return _turn_upper(points, _degrees(degrees, points), axis, axis, _centroid(points))


def bend(
    points: ArrayLike, degrees: ArrayLike = 90.0, *, along: str = "y", toward: str = "x"
) -> Float[Array, "n 3"]:
    """Return the points with their upper half turned rigidly about the middle of their extent.

    The bend of thesis Fig. 1.1, for the handles at the two ends of a bar: one end stays where it
    is, the other is rotated with respect to the centre of the bar.

    **Arguments**: points (n, 3); degrees; along, the bar's axis; toward, the axis that its
    upper end bends to. **Raises** InputError: along and toward are the same.

    Example:
        >>> import jaxdeform as jd
        >>> jd.bend([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]], 90.0).round(6).tolist()
        [[0.0, 0.0, 0.0], [2.0, 2.0, 0.0]]
    """
    points = _points(points)
    if along == toward:
        raise InputError(f"along and toward are both '{along}': a bar bends towards another axis")
    normal = np.cross(_axis(along), _axis(toward))
    return _turn_upper(points, _degrees(degrees, points), _axis(along), normal, _middle(points))


def rotation_matrices(vector: Float[Array, "g 3"]) -> Float[Array, "g 3 3"]:
    """Rodrigues' formula, with series at the zero angle so that derivatives exist there."""
    square = jnp.sum(vector**2, axis=1)
    small = square < 1e-8
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    # 1 - cos by the half angle, which loses no digits.
    cosine = jnp.where(small, 0.5 - square / 24.0, 2.0 * jnp.sin(angle / 2.0) ** 2 / safe)
    x, y, z = vector[:, 0], vector[:, 1], vector[:, 2]
    zero = jnp.zeros_like(x)
    cross = jnp.stack(
        [jnp.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], -2
    )
    eye = jnp.eye(3, dtype=vector.dtype)[None]
    return eye + sine[:, None, None] * cross + cosine[:, None, None] * (cross @ cross)


def _points(points: ArrayLike) -> Float[Array, "n 3"]:
    array = points if isinstance(points, jax.Array) else np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] == 0:
        raise InputError(f"points have shape {array.shape}: give (n, 3) with n >= 1")
    if array.dtype.kind not in "fiu":
        raise InputError(f"points are of type {array.dtype}: give numbers")
    return jnp.asarray(array, None if array.dtype.kind == "f" else float)


def _array(name: str, value: ArrayLike, dtype, *shapes: tuple[int, ...]) -> Array:
    array = jnp.asarray(value, dtype)
    if array.shape not in shapes:
        allowed = " or ".join(map(str, shapes))
        raise InputError(f"{name} has shape {array.shape}: give {allowed}")
    return array


def _axis(axis: str | ArrayLike) -> Float[np.ndarray, "3"]:
    if isinstance(axis, str):
        if axis not in ("x", "y", "z"):
            raise InputError(f"axis '{axis}': give 'x', 'y', 'z' or a vector of three numbers")
        return np.eye(3)["xyz".index(axis)]
    vector = np.asarray(axis, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise InputError(f"axis {vector.tolist()}: give 'x', 'y', 'z' or a vector that is not zero")
    return vector / np.linalg.norm(vector)


def _degrees(degrees: ArrayLike, points: Float[Array, "n 3"]) -> Array:
    return _array("degrees", degrees, points.dtype, ())


# Compiled whole, because operation by operation a first bend takes 0.9 s instead of 0.2.


@jax.jit
def _centroid(points):
    return points.mean(axis=0)


@jax.jit
def _middle(points):
    return (points.min(axis=0) + points.max(axis=0)) / 2


@jax.jit
def _turn(points, degrees, axis, center) -> Float[Array, "n 3"]:
    angle = jnp.deg2rad(degrees)
    turn = rotation_matrices((angle * axis.astype(points.dtype))[None])[0]
    return (points - center[None]) @ turn.T + center[None]


@jax.jit
def _turn_upper(points, degrees, along, axis, center) -> Float[Array, "n 3"]:
    height = points @ along.astype(points.dtype)
    upper = height > (height.min() + height.max()) / 2
    return jnp.where(upper[:, None], _turn(points, degrees, axis, center), points)
