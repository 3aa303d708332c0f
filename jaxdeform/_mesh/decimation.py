"""A coarser mesh of the same surface."""

import igl
import numpy as np
from jaxtyping import Float, Int

from jaxdeform._errors import InputError
from jaxdeform._mesh.geodesics import manifold_faces
from jaxdeform._mesh.mesh import Mesh


def decimate(
    mesh: Mesh, n_vertices: int
) -> tuple[Float[np.ndarray, "coarse 3"], Int[np.ndarray, "faces 3"], Int[np.ndarray, "coarse"]]:
    """Collapse the shortest edges until about so many vertices are left.

    Return vertices, faces, and for each vertex one of the mesh's that it stands for. Raise
    InputError where the surface is not manifold, or has one side only: libigl would crash.
    """
    faces, _ = igl.bfs_orient(manifold_faces(mesh, "a coarse mesh needs"))
    faces = np.asarray(faces, np.int64)
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    if len(np.unique(tail * mesh.n_vertices + head)) < len(tail):
        raise InputError("a coarse mesh needs a surface with two sides, unlike a Moebius band")
    most = round(len(faces) * n_vertices / mesh.referenced.sum())
    vertices, coarse, _, birth = igl.decimate(
        np.asfortranarray(mesh.vertices), np.asfortranarray(faces.astype(np.int32)), most, False
    )
    return np.ascontiguousarray(vertices), np.asarray(coarse, np.int64), np.asarray(birth, np.int64)
