"""Distances along the surface of a mesh."""

import igl
import numpy as np
from jaxtyping import Float

from jaxdeform._checks import check_handles, check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh


def geodesic_distances(mesh: Mesh, sources: ArrayLike) -> Float[np.ndarray, "vertices controls"]:
    """Return the distance along the surface from every vertex to each source.

    The distance is exact on the polyhedron, and infinite between different connected components.
    libigl computes it by the method of Mitchell, Mount and Papadimitriou, "The discrete geodesic
    problem" (1987), doi:10.1137/0216045. On a cactus of 5,300 vertices, one source takes 0.7 s.

    **Arguments**

    - mesh: the surface, closed or open.
    - sources: (controls,), vertex indices.

    **Returns** (vertices, controls), in the unit of the mesh.

    **Raises** InputError: a source is out of range or repeated; an edge has more than two faces, or
    surfaces meet in a single vertex (libigl would crash or return zeros).

    Example:
        >>> import jaxdeform as jd
        >>> jd.geodesic_distances(jd.shapes.square(), [4])[0].round(6).tolist()
        [1.414214]
    """
    check_type("mesh", mesh, Mesh)
    index = check_handles(sources, mesh.n_vertices, name="source")
    faces = np.ascontiguousarray(mesh.solid_faces)
    used = np.unique(faces)
    if not (igl.is_edge_manifold(faces)[0] and np.ravel(igl.is_vertex_manifold(faces))[used].all()):
        raise InputError("geodesic distances need a manifold surface: see jd.inspect(mesh)")
    label = mesh.components
    out = np.full((mesh.n_vertices, len(index)), np.inf)
    none = np.array([], np.int64)
    for k, source in enumerate(index):
        # Where no path exists libigl returns 0, so ask only for vertices that have one.
        reached = np.flatnonzero(label == label[source])
        if len(reached) > 1:
            out[reached, k] = igl.exact_geodesic(
                mesh.vertices, faces, np.array([source]), none, reached, none
            )
        out[source, k] = 0.0
    return out
