"""The vertices of a mesh, split by what the handles do to them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.selection import check_handles
from jaxdeform._values import read_handle_weights


def check_components(mesh: Mesh, anchored: Int[np.ndarray, "anchored"]) -> None:
    """Raise InputError if a connected component of the mesh has no handle."""
    label = mesh.components
    loose = np.flatnonzero(mesh.referenced & ~np.isin(label, label[anchored]))
    if loose.size:
        k = int(loose[0])
        size = int((label == label[k]).sum())
        raise InputError(
            f"the connected component with vertex {k} ({size} vertices) has no handle, so it could "
            "lie anywhere: add a handle there, or drop the component"
        )


class HandleSplit(NamedTuple):
    """The vertices of a mesh, split into hard handles, soft handles and free vertices."""

    index: Int[np.ndarray, "handles"]
    """The handles, in the order given."""
    free: Bool[np.ndarray, "vertices"]
    """True for each vertex that is solved for: it has a face and is not a hard handle."""
    soft: Float[np.ndarray, "vertices"]
    """The weight of each soft handle; 0 elsewhere."""


def split_handles(mesh: Mesh, handles: ArrayLike, handle_weights: ArrayLike) -> HandleSplit:
    """Split the vertices into hard handles, soft handles and free vertices, or raise InputError."""
    index = check_handles(handles, mesh)
    weights = read_handle_weights(handle_weights, index)
    check_components(mesh, index[weights > 0])
    is_soft = np.isfinite(weights)
    free, soft = mesh.referenced.copy(), np.zeros(mesh.n_vertices)
    free[index[~is_soft]] = False
    soft[index[is_soft]] = weights[is_soft]
    return HandleSplit(index, free, soft)
