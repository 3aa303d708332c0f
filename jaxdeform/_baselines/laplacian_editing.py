"""Laplacian mesh editing, the baseline of Eq. 3.2."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._arrays import is_concrete
from jaxdeform._checks import check_flag, check_precision, check_type
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._handles.split import split_handles
from jaxdeform._linalg.buckets import bucket, cut, enlarge, fill_up
from jaxdeform._linalg.cholesky import Factor, NotPositiveDefinite, factorise
from jaxdeform._linalg.ell import WIDTHS, EllMatrix
from jaxdeform._mesh.cells import spokes
from jaxdeform._mesh.laplacian import normalised_laplacian
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._values import read_positions


class _Equations(eqx.Module):
    """The normal equations, filled up to the bucket of the mesh (buckets.py).

    Without similarities, the columns of the matrix are the vertices, and the rows of ``pull`` are
    three right-hand sides. With similarities, the columns are all coordinates, and there is one
    right-hand side.
    """

    free: Bool[Array, "columns"]
    soft: Float[Array, "columns"]
    """The weight of each soft handle, 0 elsewhere."""
    pull: Float[Array, "rows columns"]
    """L^T delta, the right-hand side of the details; zero where the matrix rotates the details."""
    normal: EllMatrix
    factor: Factor


@jax.jit
def _solve(
    equations: _Equations, center: Float[Array, "3"], led: Float[Array, "3 vertices"]
) -> Float[Array, "3 vertices"]:
    """Return the edited positions, given positions that have the handles on their targets."""
    x = (led - center[:, None]).reshape(equations.pull.shape)
    fixed = jnp.where(equations.free[None], 0.0, x)
    right = equations.pull + equations.soft[None] * x - equations.normal.apply(fixed)
    solution = equations.factor.solve(jnp.where(equations.free[None], right, 0.0))
    return (fixed + solution).reshape(led.shape) + center[:, None]


class LaplacianEditor(eqx.Module):
    """Laplacian editing, factored for one mesh and handle set; call it with targets (handles, 3).

    **Fields**

    - rest: (vertices, 3) rest positions.
    - center: (3,) the centre of the mesh. Positions are solved for relative to it, so that no digit
      is lost far from the origin.
    - handles: (handles,) indices of the handle vertices, in the order of the targets' rows.
    - equations: the normal equations and their factor.
    """

    rest: Float[Array, "vertices 3"]
    center: Float[Array, "3"]
    handles: Int[np.ndarray | Array, "handles"]
    equations: _Equations

    def __call__(self, targets: ArrayLike) -> Float[Array, "vertices 3"]:
        """Return the edited positions, differentiable in the targets (handles, 3)."""
        check_precision("this editor", np.dtype(self.rest.dtype))
        targets = read_positions(
            "targets", targets, (len(self.handles), 3), np.dtype(self.rest.dtype), "handle"
        )
        if is_concrete(targets, self.rest, self.handles):
            led = np.array(self.rest)
            led[np.asarray(self.handles)] = targets
        else:
            led = self.rest.at[self.handles].set(targets)
        led = fill_up(led.T, self.equations.pull.size // 3)
        moved = _solve(self.equations, self.center, jnp.asarray(led))
        return cut(moved.T, len(self.rest), 0)


def laplacian_editor(
    mesh: Mesh,
    handles: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    handle_weights: ArrayLike = np.inf,
    similarity: bool = False,
) -> LaplacianEditor:
    """Factor Laplacian mesh editing for a mesh and a set of handles (Eq. 3.1, 3.2).

    The editor minimises ``sum_i |(L p')_i - T_i delta_i|^2 + sum_h w_h |p'_h - u_h|^2``.

    Sorkine, Cohen-Or, Lipman, Alexa, Roessl and Seidel, "Laplacian surface editing" (2004),
    doi:10.1145/1057432.1057456.

    **Arguments**

    - mesh: the rest shape.
    - handles: (handles,), vertex indices, a mask or a selection.
    - weights: (edges,), in the order of ``mesh.edges``; by default cotangent weights. ``np.ones``
      gives the uniform Laplacian.
    - handle_weights: a number or (handles,). The default, infinity, keeps the handle on its target.
    - similarity: False keeps T_i = I, so details do not rotate, and large rotations distort them.
      True makes T_i the linearised similarity that best fits the neighbourhood (Sorkine et al.
      2004): details rotate with it, up to about 90 degrees. All coordinates are then solved for at
      once.

    **Returns** a `LaplacianEditor`.

    **Raises** InputError: no handles; a handle out of range or repeated; a connected component
    without a handle; weights of the wrong shape or not finite; handles that do not determine the
    shape.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> edit = jd.laplacian_editor(mesh, [0, 1, 300, 721])
        >>> edit(mesh.vertices[[0, 1, 300, 721]] + 1.0).shape
        (722, 3)
    """
    check_type("mesh", mesh, Mesh)
    check_flag("similarity", similarity)
    n = mesh.n_vertices
    index, free, soft = split_handles(mesh, handles, handle_weights)
    cells = spokes(mesh, weights=weights)
    laplacian = normalised_laplacian(cells.edges, cells.weights, n)
    rest = mesh.vertices - mesh.center
    if similarity:
        operator = sp.kron(sp.identity(3), laplacian) - _rotated_details(
            mesh.edges, rest, laplacian
        )
        pull = np.zeros((1, 3 * n))
        free, soft = np.tile(free, 3), np.tile(soft, 3)
        positions = np.tile(rest, (3, 1))
    else:
        operator, positions = laplacian, rest
        pull = (laplacian.T @ (laplacian @ rest)).T
    dtype, size = np.dtype(jnp.result_type(float)), bucket(n)
    normal = enlarge(operator.T @ operator + sp.diags(soft), size, len(soft) // n)

    def filled_up(x: np.ndarray) -> np.ndarray:
        """Fill up the vertices of each coordinate, or of all of them at once."""
        return fill_up(x.reshape(*x.shape[:-1], -1, n), size).reshape(*x.shape[:-1], -1)

    free, positions = filled_up(free), filled_up(positions.T).T
    try:
        factor = factorise(normal, free, dtype, positions=positions)
    except NotPositiveDefinite as error:
        raise InputError(
            "the handles do not determine the shape: give each connected component at least three "
            "vertices that are not on one line"
        ) from error
    put = lambda x: jax.device_put(np.asarray(x, dtype))  # noqa: E731 (compiles nothing)
    equations = _Equations(
        free=jax.device_put(free),
        soft=put(filled_up(soft)),
        pull=put(filled_up(pull)),
        normal=EllMatrix.build([[normal]], dtype, WIDTHS[-1]),
        factor=factor,
    )
    return LaplacianEditor(put(mesh.vertices), put(mesh.center), index, equations)


def laplacian_editing(
    mesh: Mesh,
    handles: ArrayLike,
    targets: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    handle_weights: ArrayLike = np.inf,
    similarity: bool = False,
) -> Float[Array, "vertices 3"]:
    """Edit a mesh by its Laplacian coordinates, once. For many targets use laplacian_editor.

    **Arguments**

    - mesh: the rest shape.
    - handles: (handles,), vertex indices, a mask or a selection.
    - targets: (handles, 3), in the unit of the mesh.
    - weights, handle_weights, similarity: as in `laplacian_editor`.

    **Returns** the positions (vertices, 3).

    **Raises** InputError as `laplacian_editor`; also for targets that are not finite or of
    the wrong shape.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = [0, 1, 300, 721]
        >>> jd.laplacian_editing(mesh, handles, mesh.vertices[handles]).shape
        (722, 3)
    """
    edit = laplacian_editor(
        mesh, handles, weights=weights, handle_weights=handle_weights, similarity=similarity
    )
    return edit(targets)


def _rotated_details(
    edges: Int[np.ndarray, "edges 2"],
    rest: Float[np.ndarray, "vertices 3"],
    laplacian: sp.csr_matrix,
) -> sp.csr_matrix:
    """Return M with ``(M p')_i = T_i(p') delta_i``, where p' holds all x, then all y, then all z.

    ``T_i q = s q + h x q`` fits the centred neighbourhood: ``s = sum q.p' / sum |q|^2`` and
    ``h = J^-1 sum q x p'`` with ``J = sum |q|^2 I - q q^T``. This is the closed form of Sorkine et
    al. (2004).
    """
    n = len(rest)
    delta = laplacian @ rest
    i = np.concatenate([edges[:, 0], edges[:, 1], np.arange(n)])
    j = np.concatenate([edges[:, 1], edges[:, 0], np.arange(n)])
    count = np.bincount(i, minlength=n)
    center = np.stack([np.bincount(i, rest[j, a], n) for a in range(3)], 1) / count[:, None]
    q = rest[j] - center[i]
    square = np.bincount(i, (q**2).sum(axis=1), n)
    square = np.where(square > 0, square, 1.0)
    outer = np.zeros((n, 3, 3))
    np.add.at(outer, i, -q[:, :, None] * q[:, None, :])
    outer += square[:, None, None] * np.eye(3)
    inverse = np.linalg.pinv(outer)
    spin = _cross_matrices(delta)[i] @ inverse[i] @ _cross_matrices(q)
    block = delta[i][:, :, None] * q[:, None, :] / square[i][:, None, None] - spin
    rows = i[:, None, None] + n * np.arange(3)[None, :, None] + np.zeros((1, 1, 3), int)
    columns = j[:, None, None] + n * np.arange(3)[None, None, :] + np.zeros((1, 3, 1), int)
    return sp.csr_matrix((block.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, 3 * n))


def _cross_matrices(v: Float[np.ndarray, "rows 3"]) -> Float[np.ndarray, "rows 3 3"]:
    out = np.zeros((len(v), 3, 3))
    out[:, [2, 0, 1], [1, 2, 0]] = v
    out[:, [1, 2, 0], [2, 0, 1]] = -v
    return out
