"""Meshes as they are drawn: sharp edges stay sharp, the rest is shaded smoothly."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxdeform._mesh.mesh import Mesh, connected_components
from jaxdeform._mesh.polygons import area_vectors, from_triangles, triangle_area_vectors, unit
from jaxdeform._plotting.texture import Texture, textures_of

# The rest shape has an edge to see where two faces meet at more than this angle.
_SHARP = np.cos(np.radians(40.0))


class Coat(NamedTuple):
    """How a pose is painted."""

    colors: Float[np.ndarray, "vertices 3"]
    textured: bool
    """Whether the images of the mesh are over the colours."""


class Surface:
    """The faces of a mesh, with vertices split along sharp edges of the rest shape.

    The same for all poses, so that no edge flickers as a pose bends.
    """

    def __init__(self, mesh: Mesh) -> None:
        """Split the vertices."""
        self.mesh = mesh
        faces = mesh.faces
        first, second = _smooth_pairs(mesh)
        # Corners are 3 f, 3 f + 1, 3 f + 2. Those of one vertex on both sides of an edge belong
        # together.
        links = np.stack([first, second], axis=1)
        group = connected_components(links, faces.size)
        _, at, new = np.unique(group, return_index=True, return_inverse=True)
        self.index = faces.ravel()[at]
        """The vertex of each point."""
        self.faces = new.reshape(-1, 3)
        """The points of each face."""

    @cached_property
    def textures(self) -> list[Texture]:
        """The images on the mesh."""
        return textures_of(self.mesh)

    def normals(self, pose: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "points 3"]:
        """Return the direction of the surface at each point, weighted by area."""
        out = np.zeros((len(self.index), 3))
        area = np.nan_to_num(triangle_area_vectors(pose, self.mesh.faces))
        for k in range(3):
            np.add.at(out, self.faces[:, k], area)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return np.where(length > 0, out / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])

    def stretch(self, pose: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices"]:
        """Return how many times longer the surface has become in the direction of most stretch.

        The largest singular value of the map of each face from rest to pose; at a vertex the mean
        of its faces, weighted by their area at rest.
        """
        maps, area = self._rest
        corners = pose[self.mesh.solid_faces]
        edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
        f = edges @ maps
        # The larger eigenvalue of a symmetric matrix [[a, b], [b, c]].
        a, b, c = ((f[:, :, i] * f[:, :, j]).sum(axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
        largest = np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b))
        out, weight = np.zeros((2, self.mesh.n_vertices))
        for k in range(3):
            np.add.at(out, self.mesh.solid_faces[:, k], area * largest)
            np.add.at(weight, self.mesh.solid_faces[:, k], area)
        return np.where(weight > 0, out / np.where(weight > 0, weight, 1), 1.0)

    @cached_property
    def _rest(self) -> tuple[Float[np.ndarray, "solid 2 2"], Float[np.ndarray, "solid"]]:
        """For each face, the inverse of its two edges in its own plane, and its area."""
        corners = self.mesh.vertices[self.mesh.solid_faces]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        x = u / np.linalg.norm(u, axis=1, keepdims=True)
        along = (x * v).sum(axis=1, keepdims=True)
        height = np.linalg.norm(v - along * x, axis=1)
        length = np.linalg.norm(u, axis=1)
        maps = np.zeros((len(u), 2, 2))
        maps[:, 0, 0], maps[:, 0, 1] = 1 / length, -along[:, 0] / (length * height)
        maps[:, 1, 1] = 1 / height
        return maps, length * height / 2


def _smooth_pairs(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of corners of one vertex in two faces that meet at a smooth edge."""
    faces, n = mesh.faces, mesh.n_vertices
    normal = unit(area_vectors(mesh.vertices, from_triangles(faces)))
    begin = np.arange(faces.size)
    end = begin.reshape(-1, 3)[:, [1, 2, 0]].ravel()
    tail, head = faces.ravel()[begin], faces.ravel()[end]
    # Half-edges (tail, head) and (head, tail), each only once: an edge of two faces that agree.
    code, twin = tail * n + head, head * n + tail
    unique, at, count = np.unique(code, return_index=True, return_counts=True)
    place = np.searchsorted(unique, twin).clip(max=len(unique) - 1)
    found = (unique[place] == twin) & (count[place] == 1)
    found &= count[np.searchsorted(unique, code)] == 1
    half = np.flatnonzero(found)
    other = at[place[half]]
    smooth = (normal[half // 3] * normal[other // 3]).sum(axis=1) >= _SHARP
    half, other = half[smooth], other[smooth]
    # The tail of one half-edge is the head of the other.
    return np.concatenate([half, end[half]]), np.concatenate([end[other], other])
