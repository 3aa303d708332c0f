"""Small meshes of several kinds, and their cells by brute force."""

import numpy as np
from helpers import real_mesh

import jaxdeform as jd


def reach(mesh, k, r):
    """Breadth-first search, as the thesis says (Sec. 2.3)."""
    seen = {k}
    for _ in range(r):
        seen |= {int(j) for e in mesh.edges for i, j in (e, e[::-1]) if i in seen}
    return seen


def brute_cells(mesh, r):
    """E(k, r_k) as lists of edge numbers."""
    out = []
    for k in range(mesh.n_vertices):
        inside = reach(mesh, k, int(r[k]))
        out.append([e for e, (i, j) in enumerate(mesh.edges) if i in inside and j in inside])
    return out


def small_mesh():
    """An octahedron with one face subdivided: 7 vertices, several valences."""
    v = np.array(
        [
            [1, 0, 0],
            [-1, 0, 0.1],
            [0, 1.2, 0],
            [0, -1, 0],
            [0, 0.1, 1],
            [0, 0, -0.8],
            [0.4, 0.5, 0.4],
        ]
    )
    f = [[4, 0, 6], [0, 2, 6], [2, 4, 6], [4, 2, 1], [4, 1, 3], [4, 3, 0], [5, 2, 0], [5, 1, 2]]
    return jd.Mesh(v, [*f, [5, 3, 1], [5, 0, 3]])


MESHES = {
    "octahedron": small_mesh,
    "square": jd.shapes.square,
    "fan": lambda: real_mesh("fan3.obj"),
    "hourglass": lambda: real_mesh("hourglass_ico.obj"),
}


def random_case(name):
    """Return a mesh, ring numbers, positions, transformations and the generator."""
    mesh = MESHES[name]()
    rng = np.random.default_rng(0)
    n = mesh.n_vertices
    return mesh, rng.integers(1, 4, n), rng.normal(size=(n, 3)), rng.normal(size=(n, 3, 3)), rng
