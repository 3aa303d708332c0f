"""ARAP and RC-ARAP in one call. Both are the engine with rotations as its local step."""

from jaxtyping import Array, Float

from jaxdeform._checks import check_type
from jaxdeform._deformation.local_step import RotationFit
from jaxdeform._deformation.problem import precompute
from jaxdeform._deformation.solve import deform
from jaxdeform._errors import ArrayLike
from jaxdeform._mesh.cells import Cells, rings, spokes
from jaxdeform._mesh.mesh import Mesh


def arap(
    mesh: Mesh,
    handles: ArrayLike,
    targets: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
) -> Float[Array, "vertices 3"]:
    """Deform as rigidly as possible, once (Eq. 3.3).

    The one-off form of ``precompute(mesh, handles, cells=spokes(mesh))`` and ``deform(problem,
    targets, 0.0, local=RotationFit())``, which serve many targets, and say in ``result`` whether it
    converged.

    Sorkine and Alexa, "As-rigid-as-possible surface modeling" (2007),
    doi:10.2312/SGP/SGP07/109-116.

    **Arguments**

    - mesh: the rest shape.
    - handles: (handles,) vertex indices, a mask or a selection.
    - targets: (handles, 3), in the unit of the mesh.
    - weights: (edges,), as in `spokes`; by default cotangent weights, where negative ones count
      as 0.
    - start: (vertices, 3), the first guess; by default Laplacian editing.

    **Returns** the positions (vertices, 3), differentiable in the targets.

    **Raises** InputError as `precompute` and `deform` do, and where it did not converge.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> jd.arap(mesh, handles, jd.bend(mesh.vertices[handles], 90.0)).shape
        (722, 3)
    """
    check_type("mesh", mesh, Mesh)
    return _rotated(spokes(mesh, weights=weights), handles, targets, start)


def rc_arap(
    mesh: Mesh,
    handles: ArrayLike,
    targets: ArrayLike,
    r: ArrayLike = 1,
    *,
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
) -> Float[Array, "vertices 3"]:
    """Deform as rigidly as possible with cells of r rings, once (Eq. 3.4).

    The one-off form of ``precompute(mesh, handles, cells=rings(mesh, r))`` and ``deform(problem,
    targets, 0.0, local=RotationFit())``. Larger cells look stiffer.

    Chen, Gao, Lai and Xia, "Rigidity controllable as-rigid-as-possible shape deformation" (2017).

    **Arguments**: r, an integer >= 1 or one per vertex, (vertices,); weights as in `rings`; the
    others, what is returned and raised, as in `arap`.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> jd.rc_arap(mesh, handles, jd.bend(mesh.vertices[handles], 90.0), r=2).shape
        (722, 3)
    """
    check_type("mesh", mesh, Mesh)
    return _rotated(rings(mesh, r, weights=weights), handles, targets, start)


def _rotated(cells: Cells, handles, targets, start) -> Float[Array, "vertices 3"]:
    problem = precompute(cells.mesh, handles, cells=cells)
    out = deform(problem, targets, 0.0, local=RotationFit(), start=start, throw=True)
    return out.vertices
