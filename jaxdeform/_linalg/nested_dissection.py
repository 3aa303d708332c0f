"""A Cholesky factor that stays on the device: nested dissection and a partitioned inverse.

The mesh is cut into two subdomains, each of these again, and so on (George, "Nested dissection of a
regular finite element mesh", 1973, doi:10.1137/0710032). The vertices along a cut form a separator.
Separator vertices are eliminated after both subdomains they separate, so all subdomains of a level
are independent. A triangular solve would take one unknown after another. Products with stored
inverses take its place (Alvarado, Pothen and Schreiber, "Highly parallel sparse triangular
solution", 1993): for each level, a gather and a batched product on the way up the tree, and the
same on the way down. There is no scatter, and the host is not called.

This factor is made for accelerators. On two cores it takes up to 2.5 times as long as CHOLMOD
(docs/benchmarks.md).
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._linalg.elimination_tree import Border, Tree, bisect, separators

# A subdomain of this many vertices is not cut further. Smaller leaves give more levels, each of
# which costs a few kernel launches; larger leaves take more memory. For 50,298 vertices, leaves of
# 32, 64 and 128 store 5.8, 7.3 and 10.0 million numbers.
LEAF = 64


class Level(eqx.Module):
    """All fronts of one level of the tree, padded to one size.

    A front belongs to a node. It consists of the node's own unknowns, which it eliminates, and of
    its border: the unknowns of separators above that these touch.
    """

    own: Int[Array, "nodes own"]
    """The own unknowns; the number of all unknowns at fixed ones and at padding."""
    inverse: Float[Array, "nodes own own"]
    """F_ss^-1: the inverse of what is left of A at the own unknowns (s)."""
    coupling: Float[Array, "nodes border own"]
    """F_rs F_ss^-1, where r are the unknowns of the border."""
    above: Int[Array, "nodes border"]
    """Where the border stands in the front of the parent; the size of that front at padding."""
    below: Int[Array, "nodes 2 front"]
    """Where the front stands in the borders of the two children; their size where it does not."""

    def from_below(
        self, pushed: Float[Array, "children border columns"]
    ) -> Float[Array, "nodes front columns"]:
        """Return what the borders of the children push into the fronts."""
        pushed = _with_zero(pushed, axis=1)
        pushed = pushed.reshape(pushed.shape[0] // 2, 2, *pushed.shape[1:])
        return jnp.sum(jnp.take_along_axis(pushed, self.below[..., None], axis=2), axis=1)

    def from_above(
        self, front: Float[Array, "parents front columns"]
    ) -> Float[Array, "nodes border columns"]:
        """Return the solution at the borders, taken from the fronts of the parents."""
        nodes, r = self.above.shape
        above = self.above.reshape(nodes // 2, 2 * r, 1)
        border = jnp.take_along_axis(_with_zero(front, axis=1), above, axis=1)
        return border.reshape(nodes, r, front.shape[2])


class DissectedFactor(eqx.Module):
    """The inverse of the free-free block of a symmetric positive definite matrix, as products."""

    levels: tuple[Level, ...]
    """From the leaves to the root."""
    place: Int[Array, "unknowns"]
    """Where each unknown stands in the own unknowns of all levels."""

    def solve(self, right: Float[Array, "... unknowns"]) -> Float[Array, "... unknowns"]:
        """Return x with ``A_ff x_f = right_f`` and ``x = 0`` at fixed unknowns."""
        # custom_linear_solve supplies the derivatives: a symmetric solve is its own adjoint. (The
        # derivatives of the gathers would be scatters.)
        apply = lambda _, b: self._apply(b)  # noqa: E731
        return jax.lax.custom_linear_solve(lambda x: x, right, apply, symmetric=True)

    def _apply(self, right: Float[Array, "... unknowns"]) -> Float[Array, "... unknowns"]:
        *lead, n = right.shape
        columns = _with_zero(right.reshape(math.prod(lead), n).T, axis=0)
        unmoved, pushed = [], None
        for level in self.levels:
            _, r, s = level.coupling.shape
            front = jnp.pad(columns[level.own], ((0, 0), (0, r), (0, 0)))
            if pushed is not None:
                front = front + level.from_below(pushed)
            own, border = front[:, :s], front[:, s:]
            unmoved.append(_product("prs,psc->prc", level.inverse, own))
            pushed = border - _product("prs,psc->prc", level.coupling, own)
        solved, front = [], None
        for level, x in zip(reversed(self.levels), reversed(unmoved), strict=True):
            if front is None:
                front = x
            else:
                border = level.from_above(front)
                x = x - _product("prs,prc->psc", level.coupling, border)
                front = jnp.concatenate([x, border], axis=1)
            solved.append(x.reshape(x.shape[0] * x.shape[1], x.shape[2]))
        return jnp.concatenate(solved[::-1])[self.place].T.reshape(right.shape)


def _product(indices: str, a: Array, b: Array) -> Array:
    # By default a GPU would round float32 to TF32, three digits, before multiplying.
    return jnp.einsum(indices, a, b, precision="highest")


def _with_zero(x: Array, axis: int) -> Array:
    """Append the zero that padding refers to."""
    return jnp.pad(x, [(0, int(k == axis)) for k in range(x.ndim)])


def dissected_factor(
    matrix: sp.spmatrix,
    free: Bool[np.ndarray, "unknowns"],
    positions: Float[np.ndarray, "unknowns 3"],
    dtype: np.dtype,
) -> DissectedFactor:
    """Factor the free-free block of a symmetric positive definite matrix over points in space.

    The tree and all array shapes depend only on the pattern of the matrix and on the positions.
    Fixed unknowns stay in the tree, as rows of the identity, so another handle set recompiles
    nothing.

    **Raises** numpy.linalg.LinAlgError if the block is not positive definite.
    """
    n = matrix.shape[0]
    depth = int(np.ceil(np.log2(max(1.0, n / LEAF))))
    stored = sp.coo_matrix(matrix)
    i, j = stored.row.astype(np.int64), stored.col.astype(np.int64)
    tree = Tree.of(*separators(i, j, bisect(positions, depth), depth), depth)
    # A front takes the rows of its own unknowns. Columns eliminated before it are done.
    later = tree.level[j] <= tree.level[i]
    i, j = i[later], j[later]
    entries = _Entries(i, j, np.where(free[i] & free[j], stored.data[later], 0.0))

    levels = []
    below, pushed = Border.of(i[:0], i[:0], 2 << depth, n), np.zeros((2 << depth, 0, 0))
    for k in range(depth, -1, -1):
        mine = entries.select(tree.level[i] == k)
        fronts = _Fronts(tree, k, _border(tree, k, mine, below))
        own, front = fronts.assemble(mine, free)
        above = fronts.places_of(below)
        _add_pushed(front, above, pushed)
        inverse, coupling, pushed = _eliminate(front[:, : fronts.size, : fronts.size], own.shape[1])
        levels.append(_Eliminated(own, inverse, coupling, above, fronts.inverse_places(above)))
        below = fronts.border
    return _as_factor(levels, tree.place(depth), dtype)


class _Entries(NamedTuple):
    """Entries of the matrix; the front that eliminates row i takes them."""

    i: Int[np.ndarray, "entries"]
    j: Int[np.ndarray, "entries"]
    value: Float[np.ndarray, "entries"]

    def select(self, chosen: Bool[np.ndarray, "entries"]) -> "_Entries":
        return _Entries(self.i[chosen], self.j[chosen], self.value[chosen])


class _Fronts(NamedTuple):
    """The fronts of level k, before their elimination."""

    tree: Tree
    k: int
    border: Border

    @property
    def own_width(self) -> int:
        return int(self.tree.width[self.k])

    @property
    def size(self) -> int:
        return self.own_width + self.border.width

    def find(self, node, vertex):
        """Return where vertices stand in the fronts of some nodes."""
        in_border = self.own_width + self.border.find(node, vertex)
        return np.where(self.tree.level[vertex] == self.k, self.tree.slot[vertex], in_border)

    def assemble(self, mine: _Entries, free) -> tuple[np.ndarray, np.ndarray]:
        """Return the own unknowns of each front, and the fronts with the entries of the matrix.

        One row and column beyond the size of a front take what pads the borders below.
        """
        tree, nodes, n = self.tree, 1 << self.k, len(free)
        vertex = np.flatnonzero(tree.level == self.k)
        own = np.full((nodes, self.own_width), n, np.int32)
        own[tree.node[vertex], tree.slot[vertex]] = vertex
        front = np.zeros((nodes, self.size + 1, self.size + 1))
        here, row = tree.node[mine.i], tree.slot[mine.i]
        column = self.find(here, mine.j)
        front[here, row, column] = mine.value
        front[here, column, row] = mine.value
        own[~np.append(free, False)[own]] = n
        lone, at = np.nonzero(own == n)
        front[lone, at, at] = 1.0
        return own, front

    def places_of(self, below: Border) -> Int[np.ndarray, "children border"]:
        """Return where the borders of the children stand in these fronts; padding gets the size."""
        above = np.full((2 << self.k, below.width), self.size, np.int32)
        above[below.node, below.slot] = self.find(below.node // 2, below.vertex)
        return above

    def inverse_places(self, above) -> Int[np.ndarray, "nodes 2 front"]:
        """Return where the entries of these fronts stand in the borders of the two children."""
        children, width = above.shape
        found = np.full((children, self.size + 1), width, np.int32)
        found[np.arange(children)[:, None], above] = np.arange(width, dtype=np.int32)
        return found[:, : self.size].reshape(children // 2, 2, self.size)


class _Eliminated(NamedTuple):
    """A level of the factor on the host. Here ``above`` is the place of the children's borders."""

    own: np.ndarray
    inverse: np.ndarray
    coupling: np.ndarray
    above: np.ndarray
    below: np.ndarray


def _border(tree: Tree, k: int, mine: _Entries, below: Border) -> Border:
    """Return the borders of level k: unknowns above that its entries or its children touch."""
    rises, stays = tree.level[mine.j] < k, tree.level[below.vertex] < k
    return Border.of(
        np.concatenate([tree.node[mine.i[rises]], below.node[stays] // 2]),
        np.concatenate([mine.j[rises], below.vertex[stays]]),
        1 << k,
        len(tree.level),
    )


def _add_pushed(front: np.ndarray, above: np.ndarray, pushed: np.ndarray) -> None:
    """Add what the two children of each front push into it, one child at a time."""
    node = np.arange(len(front))[:, None, None]
    for side in (0, 1):
        to = above[side::2]
        front[node, to[:, :, None], to[:, None]] += pushed[side::2]


def _eliminate(front: np.ndarray, s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eliminate the first s unknowns: return F_ss^-1, F_rs F_ss^-1 and the Schur complement."""
    half = np.linalg.inv(np.linalg.cholesky(front[:, :s, :s]))
    inverse = np.swapaxes(half, 1, 2) @ half
    outside = front[:, s:, :s]
    coupling = outside @ inverse
    return inverse, coupling, front[:, s:, s:] - coupling @ np.swapaxes(outside, 1, 2)


def _as_factor(levels: list[_Eliminated], place: np.ndarray, dtype: np.dtype) -> DissectedFactor:
    """Move a factor to the device."""
    # The place of a level's border in its parent was found with the parent.
    above = [level.above for level in levels[1:]] + [np.zeros((1, 0), np.int32)]
    return DissectedFactor(
        tuple(
            Level(
                own=jnp.asarray(level.own),
                inverse=jnp.asarray(level.inverse, dtype),
                coupling=jnp.asarray(level.coupling, dtype),
                above=jnp.asarray(up),
                below=jnp.asarray(level.below),
            )
            for level, up in zip(levels, above, strict=True)
        ),
        jnp.asarray(place),
    )
