"""The energy of Eq. 4.4 and the three constant objects that carry it: B, K and A.

    E(p', T) = tr(p'^T A p') - 2 sum_k tr(T_k C_k) + sum_k tr(T_k B_k T_k^T)
               + sum_k lambda_k |T_k^T T_k - I|^2,                         C = K p'

Layout. Here, and in the local and the global step, the vertex (or cell) is the LAST axis:
positions (3, n), C and T (3, 3, n). Every operation then runs over contiguous memory, which is
what lets XLA vectorise it. The public functions keep (n, 3) and (n, 3, 3).

Lanes. Several deformations of one mesh can be evaluated side by side. The last axis is then that of
vertices and lanes, v = n lanes, the lanes of a vertex next to each other. For the local step they
are more cells; a gather fetches rows of all lanes, three times as fast as one number at a time.

Frames. ``B_k = Q_k diag(b_k) Q_k^T`` is constant, so each cell is written in its own principal
frame once and for all: K is stored as ``Q_k^T C_k``, and ``T_k Q_k`` is solved for. In that frame
B is diagonal, which makes the Hessian of the local step nearly block diagonal (local_step.py).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

from jaxdeform._mesh.cells import Cells
from jaxdeform._mesh.laplacian import difference_matrix

# A row with more entries than this is continued in an overflow row, so that one vertex of valence
# 40 (a pole) does not make every row 40 wide.
WIDEST = 24


class Rows(eqx.Module):
    """A sparse (c, n, n) operator as gathers: ``y[c, k] = sum_s coef[c, s, k] x[index[s, k]]``.

    On 51,200 cells with r = 1 this takes 1.0 ms where a CSR product takes 3.2 ms (2 cores,
    float64); BCOO and scatter-adds are slower again by a factor of ten.
    """

    index: Int[Array, "slots n"]
    coef: Float[Array, "c slots n"]
    more_index: Int[Array, "slots overflow"]
    more_coef: Float[Array, "c slots overflow"]
    more_row: Int[Array, "overflow"]
    """Rows that the overflow rows continue."""

    @staticmethod
    def build(matrices: list[sp.csr_matrix], dtype: np.dtype) -> "Rows":
        """Pack c matrices (n, n) into rows; the width is the one that stores the least."""
        n = len(matrices[0].indptr) - 1
        pattern = sp.csr_matrix(sum((abs(m) for m in matrices[1:]), start=abs(matrices[0])))
        pattern.sort_indices()
        length = np.diff(pattern.indptr)
        widths = np.arange(1, min(WIDEST, max(1, length.max(initial=1))) + 1)
        # An overflow row is added by scatter, which costs about four plain rows.
        sizes = [w * (n + 4 * np.ceil(np.maximum(length - w, 0) / w).sum()) for w in widths]
        width = int(widths[np.argmin(sizes)])
        owner = np.repeat(np.arange(n), length)
        slot = np.arange(pattern.nnz) - np.repeat(pattern.indptr[:-1], length)
        extra = np.maximum(-(-length // width) - 1, 0)
        first = n + np.r_[0, np.cumsum(extra)[:-1]]
        row = np.where(slot < width, owner, first[owner] + slot // width - 1)
        total = n + int(extra.sum())
        index = np.zeros((width, total), np.int32)
        coef = np.zeros((len(matrices), width, total), dtype)
        index[slot % width, row] = pattern.indices
        for c, matrix in enumerate(matrices):
            coef[c, slot % width, row] = np.asarray(matrix[owner, pattern.indices]).ravel()
        more_row = np.repeat(np.arange(n), extra).astype(np.int32)
        return Rows(
            *map(jnp.asarray, (index[:, :n], coef[:, :, :n])),
            *map(jnp.asarray, (index[:, n:], coef[:, :, n:], more_row)),
        )

    def apply(self, x: Float[Array, "... v"], lanes: int = 1) -> Float[Array, "... v"]:
        """Return the product of a single symmetric matrix (c = 1) and x."""
        tables = jax.tree.leaves(self)
        out = _scatter_p.bind(by_lane(x, lanes), *tables, *tables)
        return out.reshape(x.shape)


def by_lane(x: Float[Array, "... v"], lanes: int) -> Float[Array, "... n lanes"]:
    """Return x with vertices and lanes on axes of their own."""
    return x.reshape(*x.shape[:-1], -1, lanes)


def _pick(x: Float[Array, "... n lanes"], index: Int[Array, "k"]) -> Float[Array, "... k lanes"]:
    # Were negative indices allowed, each entry would be checked for it, in the innermost loop: of
    # 16 bars K would take 0.30 instead of 0.05 ms.
    return x.at[..., index, :].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _gather(x: Float[Array, "... n lanes"], rows: Rows) -> Float[Array, "... c n lanes"]:
    """Return ``y[..., c, k, :] = sum_s coef[c, s, k] x[..., index[s, k], :]``."""

    def apply(index, coef):
        picked = [_pick(x, index[s]) for s in range(index.shape[0])]
        return jnp.stack(
            [
                sum(_times(coef[c, s], picked[s]) for s in range(len(picked)))
                for c in range(len(coef))
            ],
            axis=-3,
        )

    y = apply(rows.index, rows.coef)
    if rows.more_row.shape[0]:
        y = y.at[..., rows.more_row, :].add(apply(rows.more_index, rows.more_coef))
    return y


def _gather_sum(y: Float[Array, "... c n lanes"], rows: Rows) -> Float[Array, "... n lanes"]:
    """Return ``x[..., k, :] = sum_{c, s} coef[c, s, k] y[..., c, index[s, k], :]``."""

    def apply(index, coef):
        return sum(
            _times(coef[c, s], _pick(y[..., c, :, :], index[s]))
            for c in range(len(coef))
            for s in range(index.shape[0])
        )

    x = jnp.asarray(apply(rows.index, rows.coef))
    if rows.more_row.shape[0]:
        x = x.at[..., rows.more_row, :].add(apply(rows.more_index, rows.more_coef))
    return x


def _times(coef: Float[Array, "n"], x: Float[Array, "... n lanes"]) -> Float[Array, "... n lanes"]:
    return coef.reshape(*[1] * (x.ndim - 2), -1, 1) * x


# K and its transpose as one pair of primitives, each the other's derivative rule. Without it JAX
# would transpose the gathers into scatter-adds, which cost ten times as much. (custom_vjp would
# lose forward mode, linear_call has no vmap.)
_scatter_p = Primitive("jaxdeform_scatter")
_adjoint_p = Primitive("jaxdeform_scatter_adjoint")


def _unflatten(tables) -> tuple[Rows, Rows]:
    return Rows(*tables[:5]), Rows(*tables[5:])


def _scatter_impl(x, *tables):
    return _gather(x, _unflatten(tables)[0])


def _adjoint_impl(y, *tables):
    return _gather_sum(y, _unflatten(tables)[1])


def _register(primitive: Primitive, impl, transposed: Primitive, shape) -> None:
    primitive.def_impl(partial(jax.jit(impl)))

    @primitive.def_abstract_eval
    def _abstract(x, *tables):
        return ShapedArray(shape(x.shape, tables), x.dtype)

    mlir.register_lowering(primitive, mlir.lower_fun(impl, multiple_results=False))

    def transpose(ct, x, *tables):
        del x
        return [transposed.bind(ct, *tables), *(None for _ in tables)]

    def jvp(primals, tangents):
        # Only x has a tangent: the tables are geometry, fixed when the problem was made.
        x, *tables = primals
        out = primitive.bind(x, *tables)
        if isinstance(tangents[0], ad.Zero):
            return out, ad.Zero.from_primal_value(out)  # pyright: ignore[reportAttributeAccessIssue]
        return out, primitive.bind(tangents[0], *tables)

    def batch(args, axes):
        x, *tables = args
        if any(axis is not None for axis in axes[1:]):
            raise NotImplementedError("vmap over problems: they differ in structure; loop instead")
        x = jnp.moveaxis(x, axes[0], -1)
        y = primitive.bind(x.reshape(*x.shape[:-2], -1), *tables)
        return y.reshape(*y.shape[:-1], *x.shape[-2:]), y.ndim

    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batch


_register(
    _scatter_p,
    _scatter_impl,
    _adjoint_p,
    lambda x, tables: (*x[:-2], tables[1].shape[0], *x[-2:]),
)
_register(_adjoint_p, _adjoint_impl, _scatter_p, lambda y, tables: (*y[:-3], *y[-2:]))


class Scatter(eqx.Module):
    """K of ``C = K p'`` in the cells' frames, and its adjoint, both as gathers.

    ``scatter(p)`` is ``C_k = Q_k^T sum_e w_e e e'^T`` and ``scatter.adjoint(T)`` is the right-hand
    side b of Eq. 4.5, because b is exactly K^T T.
    """

    forward: Rows
    backward: Rows

    def __call__(self, positions: Float[Array, "3 v"], lanes: int = 1) -> Float[Array, "3 3 v"]:
        """Return C (rest axis, deformed axis, cell)."""
        out = _scatter_p.bind(by_lane(positions, lanes), *self._tables())
        return jnp.swapaxes(out.reshape(3, 3, -1), 0, 1)

    def adjoint(self, transforms: Float[Array, "3 3 v"], lanes: int = 1) -> Float[Array, "3 v"]:
        """Return K^T T for T (deformed axis, rest axis, cell)."""
        out = _adjoint_p.bind(by_lane(transforms, lanes), *self._tables())
        return out.reshape(3, -1)

    def _tables(self):
        return (*jax.tree.leaves(self.forward), *jax.tree.leaves(self.backward))


def scatter(
    cells: Cells,
    vertices: Float[np.ndarray, "n 3"],
    frames: Float[np.ndarray, "n 3 3"],
    dtype: np.dtype,
) -> Scatter:
    """Return K with its rows turned into the cells' frames."""
    edge = vertices[cells.edges[:, 0]] - vertices[cells.edges[:, 1]]
    difference = difference_matrix(cells.edges, cells.n_vertices)
    member = cells.membership.astype(np.float64)
    plain = [(member @ sp.diags(cells.weights * edge[:, a]) @ difference).tocsr() for a in range(3)]
    turned = [
        sp.csr_matrix(sum(sp.diags(frames[:, a, c]) @ plain[a] for a in range(3))) for c in range(3)
    ]
    return Scatter(Rows.build(turned, dtype), Rows.build([m.T.tocsr() for m in turned], dtype))


def stiffness(cells: Cells) -> sp.csc_matrix:
    """Return A of Eq. 4.5: the Laplacian whose edges weigh ``d_e w_e``."""
    difference = difference_matrix(cells.edges, cells.n_vertices)
    return (difference.T @ sp.diags(cells.overlap * cells.weights) @ difference).tocsc()


def local_energy(
    transforms: Float[Array, "3 3 n"],
    c: Float[Array, "3 3 n"],
    b: Float[Array, "3 n"],
    rigidity: Float[Array, "n"],
    lanes: int | None = None,
) -> Float[Array, "*lanes"]:
    """Return the sum over all cells of ``lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C)``."""
    gram = [[_dot(transforms[:, i], transforms[:, j]) for j in range(i + 1)] for i in range(3)]
    stretch = sum((gram[i][i] - 1.0) ** 2 for i in range(3))
    shear = sum(gram[i][j] ** 2 for i in range(3) for j in range(i))
    data = sum(b[i] * gram[i][i] - 2.0 * _dot(transforms[:, i], c[i]) for i in range(3))
    return total(rigidity * (stretch + 2.0 * shear) + data, lanes)


def total(x: Float[Array, "..."], lanes: int | None = None) -> Float[Array, "*lanes"]:
    """Return the sum over all entries (of each lane), which are worked out first, in parallel.

    A plain sum would take their expression into itself, where a single thread works it out (0.8
    instead of 0.2 ms for 51,200 cells). The choice changes nothing, but keeps XLA from doing so.
    """
    x = jnp.where(jnp.isnan(x), jnp.nan, x)
    return jnp.sum(x) if lanes is None else jnp.sum(x.reshape(-1, lanes), axis=0)


def _dot(u: Float[Array, "3 n"], v: Float[Array, "3 n"]) -> Float[Array, "n"]:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
