"""A start from a coarser mesh, whose cells are made as thin as those of the fine one.

A sheet of cells resists bending as if it were as thick as its cells are wide, so a coarse mesh is a
thicker shell. With the principal moments b of a cell (the normal axis first), its energy is

    sum over edges of w |e' - G e|^2  +  sum over axes c of b_c |T q_c - K_c p' / b_c|^2  +  strain,

where G is the linear map that fits the edges best. The first sum is the bending. It and the normal
axis are multiplied with alpha, the area of a fine cell over that of a coarse one, so

    A' = alpha A + (1 - alpha) sum over the two tangential axes of K_c^T diag(1 / b_c) K_c,

and b and K of the normal axis become alpha b and alpha K. (alpha = 1 is the coarse mesh as it is.)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from jaxdeform._arrays import is_concrete
from jaxdeform._checks import check_count
from jaxdeform._deformation.arguments import from_center, read_inputs
from jaxdeform._deformation.covariance import CovarianceMap, covariance_blocks, stiffness
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.metric_factor import compliance
from jaxdeform._deformation.problem import Problem, check_problem, precompute
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.reduced_energy import Inputs
from jaxdeform._deformation.solve import deform
from jaxdeform._deformation.system import System
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._linalg.buckets import bucket, cut, enlarge, fill_up
from jaxdeform._linalg.cholesky import factorise
from jaxdeform._linalg.ell import WIDTHS, EllMatrix
from jaxdeform._mesh.cells import Cells, principal_moments, rings, spokes
from jaxdeform._mesh.decimation import decimate
from jaxdeform._mesh.laplacian import cotangent_weights, lifted_weights
from jaxdeform._mesh.mesh import Mesh

# A fine cell takes its transformation from so many coarse ones.
_NEIGHBOURS = 6
# What the coarse mesh leaves open is far larger: 0.5 % of the energy.
_TOLERANCE = 1e-5


class CoarseProblem(eqx.Module):
    """A problem and a coarser one of the same surface. Made by `coarsen`.

    **Fields**

    - fine: the problem that it was made of.
    - coarse: the coarser problem, with its cells made thin.
    - rows: (coarse handles,) the row of ``targets`` that each handle of ``coarse`` goes to.
    - nearest, share: (6, n) the coarse cells next to each fine one, and what each counts.
    """

    fine: Problem
    coarse: Problem
    rows: Int[Array, "handles"]
    nearest: Int[Array, "6 vertices"]
    share: Float[Array, "6 vertices"]

    def start(
        self,
        targets: ArrayLike,
        rigidity: ArrayLike,
        *,
        local: LocalStep = Newton(),  # noqa: B008 (frozen)
    ) -> Float[Array, "vertices 3"]:
        """Deform the coarse mesh, and bring its transformations back to the fine one.

        **Arguments**: targets, rigidity and local, as in `deform`.

        **Returns** (vertices, 3), for ``deform(..., start=)``. It works under jit and vmap.

        **Raises** InputError as `deform` does.
        """
        problem = self.fine
        check_problem(problem)
        targets = from_center(problem, "targets", targets, (len(problem.handles), 3), "handle")
        inputs = read_inputs(problem, targets, rigidity, None)
        system = self.coarse.system
        felt = _coarse_rigidity(problem.system, system, self.nearest[0], inputs.rigidity)
        out = deform(
            self.coarse,
            jnp.asarray(targets)[:, self.rows].T + problem.system.center[None],
            cut(felt, self.coarse.n_vertices),
            local=local,
            solver=QuasiNewton(_TOLERANCE),
        )
        start = _bring_back(problem.system, inputs, out.transforms, self.nearest, self.share)
        return cut(start, problem.n_vertices, -2)


def coarsen(problem: Problem, n_vertices: int = 2000) -> CoarseProblem:
    """Make a coarser problem of the same surface, for starts close to the minimum.

    Where materials are stiff and meshes fine, most of a deformation is spent on the way through
    large bends, which a coarse mesh goes as well: docs/paths.md has what it saves. Meshes
    that bend in many places have many minima, and this start may lead to another one than
    Laplacian editing does, with a lower energy or a higher one.

    The surface is decimated by collapsing its shortest edges. Coarse vertices next to handles are
    moved onto them. It is made once for all targets and rigidities, and takes about as long as
    `precompute`.

    **Arguments**

    - problem: from `precompute`, not traced by JAX.
    - n_vertices: about how many vertices the coarse mesh has, at least 4 and fewer than the mesh.

    **Returns** a `CoarseProblem`.

    **Raises** InputError: n_vertices is not below the number of vertices; the surface is not
    manifold, or has one side only.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> ends = jd.select.where(mesh, "y < 6 or y > 145")
        >>> problem = jd.precompute(mesh, ends)
        >>> targets = jd.bend(mesh.vertices[problem.handles], 60.0)
        >>> start = jd.coarsen(problem, 300).start(targets, 30.0)
        >>> out = jd.deform(problem, targets, 30.0, start=start)
        >>> bool(out.energy[0] < 1.2 * out.energy[out.steps])
        True
    """
    check_problem(problem)
    n_vertices = check_count("n_vertices", n_vertices, least=4, most=2**31 - 1)
    mesh = problem.mesh
    if not is_concrete(problem):
        raise InputError("problem is traced by JAX: call coarsen outside of jit")
    if n_vertices >= mesh.referenced.sum():
        raise InputError(
            f"n_vertices is {n_vertices}, but the mesh has {mesh.referenced.sum()} in its faces: "
            "give fewer; a coarse start pays from about twice as many vertices"
        )
    points, faces, birth = decimate(mesh, n_vertices)
    component = mesh.components[birth]
    everywhere = _places(mesh, mesh.vertices, mesh.components)
    rows = np.flatnonzero(mesh.referenced[problem.handles])
    handles = np.asarray(problem.handles)[rows]
    near, taken, first = _nearest_handles(_places(mesh, points, component), everywhere[handles])
    points[taken] = mesh.vertices[handles[first]]
    weights = np.bincount(near, problem.handle_weights[rows], len(points))[taken]
    coarse = Mesh(points, faces)
    cells = _like(problem.own_cells, coarse)
    made = precompute(coarse, taken, cells=cells, handle_weights=weights, dtype=problem.dtype)
    nearest, share = _neighbours(_places(mesh, points, component), everywhere)
    return CoarseProblem(
        fine=problem,
        coarse=_thinner(made, min(1.0, _mean_area(problem) / _mean_area(made))),
        rows=jnp.asarray(rows[first], jnp.int32),
        nearest=jnp.asarray(fill_up(nearest.T.astype(np.int32), problem.bucket)),
        share=jnp.asarray(fill_up(share.T.astype(problem.dtype), problem.bucket)),
    )


def _places(
    mesh: Mesh, points: Float[np.ndarray, "points 3"], component: Int[np.ndarray, "points"]
) -> Float[np.ndarray, "points 4"]:
    """Return points in diagonals, and as a fourth coordinate what keeps components apart."""
    return np.column_stack([(points - mesh.center) / mesh.diagonal, 10.0 * component])


def _nearest_handles(
    coarse: Float[np.ndarray, "coarse 4"], handles: Float[np.ndarray, "handles 4"]
) -> tuple[Int[np.ndarray, "handles"], Int[np.ndarray, "taken"], Int[np.ndarray, "taken"]]:
    """Return the coarse vertex nearest to each handle, those vertices, and the handle of each.

    Of the handles that one coarse vertex is nearest to, the nearest takes it.
    """
    distance, near = scipy.spatial.KDTree(coarse).query(handles)
    order = np.lexsort((distance, near))
    taken, first = np.unique(near[order], return_index=True)
    return near, taken, order[first]


def _like(cells: Cells, mesh: Mesh) -> Cells:
    """Return spokes if these are spokes, else rings of 1; without negative weights."""
    weights = lifted_weights(cotangent_weights(mesh))
    are_spokes = cells.membership.nnz == 2 * len(cells.edges)
    return spokes(mesh, weights=weights) if are_spokes else rings(mesh, 1, weights=weights)


def _mean_area(problem: Problem) -> float:
    trace = np.asarray(problem.system.principal_moments).sum(axis=0)
    return float(trace.sum() / problem.mesh.referenced.sum())


def _neighbours(
    coarse: Float[np.ndarray, "coarse 4"], places: Float[np.ndarray, "vertices 4"]
) -> tuple[Int[np.ndarray, "vertices 6"], Float[np.ndarray, "vertices 6"]]:
    """Return the nearest coarse vertices, and the shares of each by inverse squared distance."""
    count = min(_NEIGHBOURS, len(coarse))
    distance, nearest = scipy.spatial.KDTree(coarse).query(places, k=count)
    missing = (0, 0), (0, _NEIGHBOURS - count)
    weight = 1.0 / np.maximum(np.pad(distance, missing, constant_values=np.inf), 1e-12) ** 2
    return np.pad(nearest, missing), weight / weight.sum(axis=1, keepdims=True)


def _thinner(problem: Problem, alpha: float) -> Problem:
    """Return the problem with cells whose thickness is multiplied with the root of alpha."""
    cells, dtype = problem.own_cells, problem.dtype
    size = bucket(cells.n_vertices)
    rest = cells.mesh.vertices - cells.mesh.center
    moments, axes = principal_moments(cells)
    blocks = covariance_blocks(cells, rest, axes, size)
    matrix = alpha * enlarge(stiffness(cells), size)
    inverse = fill_up(compliance(moments.T, np.zeros(len(moments))), size)
    for axis in (1, 2):
        fit = sp.diags(inverse[axis]) @ blocks[axis]
        matrix = matrix + (1.0 - alpha) * (blocks[axis].T @ fit)
    matrix = sp.csr_matrix(matrix + sp.diags(np.asarray(problem.system.soft)))
    free = np.asarray(problem.system.free)
    system = eqx.tree_at(
        lambda s: (s.principal_moments, s.covariance, s.stiffness, s.factor),
        problem.system,
        (
            problem.system.principal_moments * jnp.asarray([[alpha], [1.0], [1.0]], dtype),
            CovarianceMap.of([alpha * blocks[0], *blocks[1:]], dtype),
            EllMatrix.build([[matrix]], dtype, WIDTHS[-1]),
            factorise(matrix, free, dtype, positions=fill_up(rest.T, size).T),
        ),
    )
    return Problem(system.sealed(problem.handles), problem.handles, cells)


@jax.jit
def _coarse_rigidity(
    fine: System,
    coarse: System,
    nearest: Int[Array, "vertices"],
    rigidity: Float[Array, "vertices"],
) -> Float[Array, "coarse"]:
    """Return the rigidity of the same material: of the fine cells near, for each area."""
    area = jnp.maximum(jnp.sum(fine.principal_moments, axis=0), 0.0)
    zero = jnp.zeros_like(coarse.soft)
    weight = zero.at[nearest].add(area)
    felt = zero.at[nearest].add(jnp.where(area > 0.0, rigidity, 0.0))
    mean = jnp.sum(felt) / jnp.sum(weight)
    constant = jnp.where(weight > 0.0, felt / jnp.where(weight > 0.0, weight, 1.0), mean)
    return constant * jnp.maximum(jnp.sum(coarse.principal_moments, axis=0), 0.0)


@jax.jit
def _bring_back(
    system: System,
    inputs: Inputs,
    transforms: Float[Array, "coarse 3 3"],
    nearest: Int[Array, "6 vertices"],
    share: Float[Array, "6 vertices"],
) -> Float[Array, "vertices 3"]:
    """Return the positions that fit the transformations of the coarse cells: one global step."""
    transforms = jnp.where(jnp.isnan(transforms), jnp.eye(3, dtype=transforms.dtype), transforms)
    t = jnp.einsum("nv,nvji->jiv", share, transforms[nearest], precision="highest")
    t = system.into_axes(t)
    p = jnp.where(system.free[None], system.rest, inputs.targets)
    pull = system.covariance.transpose(t) + inputs.soft[None] * inputs.targets
    gradient = jnp.where(system.free[None], system.stiffness.apply(p) - pull, 0.0)
    return (p - system.factor.solve(gradient) + system.center[:, None]).T
