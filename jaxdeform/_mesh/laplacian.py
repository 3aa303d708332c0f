"""Cotangent weights and the weighted graph Laplacian (thesis Sec. 2.4).

What the energy does about negative weights stands in bounded.py; `normalised_laplacian`, which
divides by their sum, bounds that sum itself.
"""

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from jaxdeform._checks import check_type
from jaxdeform._mesh.mesh import Mesh


def cotangent_weights(mesh: Mesh) -> Float[np.ndarray, "edges"]:
    """Return one weight per row of ``mesh.edges``: ``w_ij = (cot a + cot b) / 2``.

    The angles a and b are opposite to the edge (thesis Sec. 2.4; Pinkall and Polthier, "Computing
    discrete minimal surfaces and their conjugates", 1993, doi:10.1080/10586458.1993.10504266). A
    border edge has one such angle, an edge with three faces has three. Weights have no unit: they
    do not change when the mesh is scaled.

    A weight is negative where the angles sum to more than 180 degrees. Such weights are kept
    wherever the energy of every cell has a lower bound with them; elsewhere they count as 0, and
    `precompute` warns. To have none from the start, pass ``np.maximum(w, 1e-6)`` to
    `rings` or `spokes`.

    **Arguments**: mesh.

    **Returns** (edges,) floats, in the order of ``mesh.edges``.

    Example:
        >>> import jaxdeform as jd
        >>> jd.cotangent_weights(jd.shapes.bar()).shape
        (2160,)
    """
    check_type("mesh", mesh, Mesh)
    # Scale first, because libigl squares areas: a mesh 1e-90 wide would underflow.
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    vertices = vertices / np.abs(vertices).max()
    matrix = igl.cotmatrix(vertices, mesh.solid_faces).tocsr()
    i, j = mesh.edges.T
    weights = np.asarray(matrix[i, j]).ravel()
    if not np.isfinite(weights).all():
        # libigl takes areas from lengths, which sees none in a triangle of height 1e-8.
        weights = _weights_by_products(mesh, vertices)
    return weights


def _weights_by_products(
    mesh: Mesh, vertices: Float[np.ndarray, "vertices 3"]
) -> Float[np.ndarray, "edges"]:
    """Return the cotangent weights by dot and cross products, corner by corner."""
    corner = [vertices[k] for k in mesh.solid_faces.T]
    weights = np.zeros(len(mesh.edges))
    for k, edge in enumerate(opposite_edges(mesh)):
        u, v = (corner[(k + step) % 3] - corner[k] for step in (1, 2))
        cotangent = (u * v).sum(axis=1) / np.linalg.norm(np.cross(u, v), axis=1)
        np.add.at(weights, edge, 0.5 * cotangent)
    return weights


def opposite_edges(mesh: Mesh) -> Int[np.ndarray, "3 faces"]:
    """Return the row of ``mesh.edges`` opposite to each corner of each face that has an area."""
    i, j = mesh.solid_faces[:, [1, 2, 0]].T, mesh.solid_faces[:, [2, 0, 1]].T
    keys = mesh.edges[:, 0] * mesh.n_vertices + mesh.edges[:, 1]  # edges are in ascending order
    return np.searchsorted(keys, np.minimum(i, j) * mesh.n_vertices + np.maximum(i, j))


def lifted_weights(weights: Float[np.ndarray, "edges"]) -> Float[np.ndarray, "edges"]:
    """Return the weights, each at least 1e-3 of their mean absolute value."""
    return np.maximum(weights, 1e-3 * np.abs(weights).mean())


def difference_matrix(edges: Int[np.ndarray, "edges 2"], n_vertices: int) -> sp.csr_matrix:
    """Return D, (edges, vertices), with ``(D p)_e = p_i - p_j`` for the edge e = (i, j)."""
    count = len(edges)
    rows = np.repeat(np.arange(count), 2)
    signs = np.tile([1.0, -1.0], count)
    return sp.csr_matrix((signs, (rows, edges.ravel())), shape=(count, n_vertices))


def graph_laplacian(
    edges: Int[np.ndarray, "edges 2"], weights: Float[np.ndarray, "edges"], n_vertices: int
) -> sp.csr_matrix:
    """Return ``D^T diag(w) D``. It is positive semidefinite if no weight is negative."""
    difference = difference_matrix(edges, n_vertices)
    return (difference.T @ sp.diags(weights) @ difference).tocsr()


def normalised_laplacian(
    edges: Int[np.ndarray, "edges 2"], weights: Float[np.ndarray, "edges"], n_vertices: int
) -> sp.csr_matrix:
    """Return L of Eq. 3.1: each row of the Laplacian divided by the sum of weights at its vertex.

    Where negative weights bring that sum near 0, 1e-2 of the sum of absolute weights is used.
    """
    largest = np.max(np.abs(weights), initial=0.0)
    weights = weights / (largest if largest > 0 else 1.0)  # their scale cancels, but may overflow
    laplacian = graph_laplacian(edges, weights, n_vertices)
    size = sum(np.bincount(end, np.abs(weights), n_vertices) for end in edges.T)
    total = np.maximum(laplacian.diagonal(), 1e-2 * size)
    total = np.where(total > np.finfo(float).tiny, total, 1.0)
    return sp.csr_matrix(sp.diags(1.0 / total) @ laplacian)
