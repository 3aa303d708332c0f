"""What tests share: named tolerances, meshes, settings and small measures."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxdeform as jd

EXACT = 1e-10
"""float64 algebra."""
PEER = 1e-6
"""libigl: its rotations are float32."""
FD = 1e-4
"""Central differences, relative."""

CASES = Path(__file__).parent / "cases"
"""Small files as other programs write them."""

REAL = Path(__file__).parents[2] / "shared" / "meshes"

TWENTY = jd.Alternating(steps=20)
TIGHT = jd.QuasiNewton(tolerance=1e-15)
# The look for saddles takes half the time of compilation. Others test it.
NO_SADDLES = jd.QuasiNewton(leave_saddles=False)
THESIS = jd.Alternating(steps=100)

NOISE = 1e-4
"""Of the bounding box diagonal, per coordinate."""

BLENDS = [jd.linear_blend_skinning, jd.dual_quaternion_skinning]

CUBE = jd.Mesh(
    [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)],
    # Two triangles a side, seen from outside.
    [
        *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
        *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
    ],
)


def real_mesh(name: str) -> jd.Mesh:
    """Return one of the real meshes, or skip where they are not at hand."""
    path = REAL / name
    if not path.exists():
        pytest.skip(f"{name} is not shipped with the project (needs {path.parent.name}/ beside it)")
    return jd.load_mesh(path)


def ends(mesh: jd.Mesh, fraction: float = 0.04, along: int = 1) -> np.ndarray:
    """Return the vertices at both ends along an axis, by default y."""
    y = mesh.vertices[:, along]
    height = (y - y.min()) / np.ptp(y)
    return np.flatnonzero((height < fraction) | (height > 1 - fraction))


def lower_and_upper(bar: jd.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices at the two ends of the bar."""
    y = bar.vertices[:, 1]
    return np.flatnonzero(y < 6), np.flatnonzero(y > 145)


def tetrahedron(offset=0.0):
    """Return the arrays of a tetrahedron."""
    v = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + offset
    return v, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def replaced(array, at, value):
    """Return a copy with one entry set to a value."""
    out = np.array(array)
    out[at] = value
    return out


def relative(a, b) -> float:
    """Return the largest difference, relative to the size of b."""
    a, b = np.asarray(a), np.asarray(b)
    return np.abs(a - b).max() / np.ptp(b, axis=0).max()


def motions(rotations, shifts):
    """Return rigid motions (m, 3, 4) by SciPy."""
    turn = Rotation.from_rotvec(np.asarray(rotations, float)).as_matrix()
    return np.concatenate([turn, np.asarray(shifts, float)[:, :, None]], axis=2)


def random_skin(n=40, m=4, seed=0, spread=0.8):
    """Return random vertices, weights and rigid motions."""
    rng = np.random.default_rng(seed)
    weights = rng.uniform(size=(n, m)) ** 3
    weights /= weights.sum(axis=1, keepdims=True)
    moves = motions(spread * rng.normal(size=(m, 3)), rng.normal(size=(m, 3)))
    return rng.normal(size=(n, 3)), weights, moves


def bumpy_sheet() -> jd.Mesh:
    """Return an open sheet of 8 x 7 vertices with hills, in no direction symmetric.

    It is small enough for loops, dense matrices and SciPy's slow but sure solvers.
    """
    x, y = np.meshgrid(np.arange(8.0), np.arange(7.0))
    z = 0.6 * np.sin(1.3 * x) * np.cos(0.9 * y)
    low = (np.arange(7)[None] + 8 * np.arange(6)[:, None]).ravel()
    faces = [np.stack([low, low + 1, low + 9], 1), np.stack([low, low + 9, low + 8], 1)]
    return jd.Mesh(np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate(faces))


ONE_CPU = pytest.mark.skipif(shutil.which("taskset") is None, reason="needs taskset")


def one_cpu() -> tuple[str, ...]:
    """Return the words before a command that give it one CPU."""
    return "taskset", "-c", str(min(os.sched_getaffinity(0)))


def held_sheet():
    """Return the sheet, the handles at two of its sides, and where they go."""
    mesh = bumpy_sheet()
    handles = np.flatnonzero((mesh.vertices[:, 0] == 0) | (mesh.vertices[:, 0] == 7))
    return mesh, handles, np.asarray(jd.bend(mesh.vertices[handles], 60.0, along="x", toward="z"))


def noisy(mesh: jd.Mesh, pose: np.ndarray, seed: int, noise: float = NOISE) -> np.ndarray:
    """Return the pose with independent noise at every coordinate."""
    draw = np.random.default_rng(seed).standard_normal(pose.shape)
    return pose + noise * mesh.diagonal * draw


def moved(mesh):
    """Return positions of which none is what it was, and no face keeps its plane."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    return mesh.vertices @ turn * 1.3 + 0.1 * np.sin(7 * mesh.vertices) + 0.7


def crosses(points, *faces):
    """Return the mean normals of polygons, by loops."""
    out = []
    for face in faces:
        total = np.zeros(3)
        for k, here in enumerate(face):
            total += np.cross(
                points[here] - points[0], points[face[(k + 1) % len(face)]] - points[0]
            )
        out.append(total)
    return out


def without_buckets(patch) -> None:
    """Let arrays be as long as the mesh, without what fills them up to their bucket."""
    for name in ("_deformation.problem", "_deformation.system", "_baselines.laplacian_editing"):
        patch.setattr(f"jaxdeform.{name}.bucket", lambda n: n)
