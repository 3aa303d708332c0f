"""A Cholesky factor that stays on the device: nested dissection and a partitioned inverse.

The mesh is cut in two, each part again, and so on (George 1973). The vertices along a cut, its
separator, are eliminated after the two parts that they part, so all parts of a level can be worked
on together. What a triangular solve would do one unknown after another is done by products with
stored inverses instead (Alvarado, Pothen and Schreiber 1993): per level a gather and a batched
product on the way up the tree, the same on the way down. No scatter, no host.

Made for accelerators. On two cores it takes up to 2.5 times as long as CHOLMOD
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
from scipy.sparse.csgraph import maximum_bipartite_matching

# Vertices in a part that is not cut any further. Fewer would mean more levels, each of which costs
# a few launches; more would mean more to store (50,298 vertices: 32 stores 5.8 million numbers, 64
# 7.3, 128 10.0).
LEAF = 64


class Level(eqx.Module):
    """All fronts of one depth of the tree, padded to one size.

    A front is a part's own unknowns, s of them, and its border, r of them: the unknowns of
    separators above that it touches.
    """

    own: Int[Array, "parts s"]
    """Vertices; n at fixed ones and where there are fewer."""
    inverse: Float[Array, "parts s s"]
    """F_ss^-1: the inverse of what is left of A at the part's own unknowns."""
    coupling: Float[Array, "parts r s"]
    """F_rs F_ss^-1."""
    above: Int[Array, "parts r"]
    """Where the border stands in the front of the part above; its size where there is none."""
    below: Int[Array, "parts 2 front"]
    """Where the front's entries stand in the borders of the two parts below, or their size."""

    def from_below(self, pushed: Float[Array, "below r c"]) -> Float[Array, "parts front c"]:
        """Return what the borders of the parts below push into the fronts."""
        pushed = _with_zero(pushed, axis=1)
        pushed = pushed.reshape(pushed.shape[0] // 2, 2, *pushed.shape[1:])
        return jnp.sum(jnp.take_along_axis(pushed, self.below[..., None], axis=2), axis=1)

    def from_above(self, front: Float[Array, "above front c"]) -> Float[Array, "parts r c"]:
        """Return the border's part of the solution in the fronts above."""
        parts, r = self.above.shape
        above = self.above.reshape(parts // 2, 2 * r, 1)
        border = jnp.take_along_axis(_with_zero(front, axis=1), above, axis=1)
        return border.reshape(parts, r, front.shape[2])


class DissectedFactor(eqx.Module):
    """The inverse of the free part of a symmetric positive definite matrix, in products."""

    levels: tuple[Level, ...]
    """From the leaves to the root."""
    place: Int[Array, "n"]
    """Where each vertex stands in the own unknowns of all levels."""

    def solve(self, right: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Return x with ``A_ff x_f = right_f`` and ``x = 0`` at fixed vertices."""
        # custom_linear_solve gives the derivatives: a symmetric solve is its own adjoint. (Those
        # of the gathers would be scatters.)
        apply = lambda _, b: self._apply(b)  # noqa: E731
        return jax.lax.custom_linear_solve(lambda x: x, right, apply, symmetric=True)

    def _apply(self, right: Float[Array, "... n"]) -> Float[Array, "... n"]:
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
    # A GPU would by default round float32 to TF32, three digits, before it multiplies.
    return jnp.einsum(indices, a, b, precision="highest")


def _with_zero(x: Array, axis: int) -> Array:
    """Append one zero, which padding refers to."""
    return jnp.pad(x, [(0, int(k == axis)) for k in range(x.ndim)])


def dissected_factor(
    matrix: sp.spmatrix,
    free: Bool[np.ndarray, "n"],
    positions: Float[np.ndarray, "n 3"],
    dtype: np.dtype,
) -> DissectedFactor:
    """Factor the free part of a symmetric positive definite matrix over vertices at positions.

    The tree and all shapes depend on the pattern of the matrix and the positions alone: fixed
    unknowns stay in it, as rows of the identity, so another handle set compiles nothing.

    **Raises** numpy.linalg.LinAlgError where it is not positive definite.
    """
    n = matrix.shape[0]
    depth = int(np.ceil(np.log2(max(1.0, n / LEAF))))
    entries = sp.coo_matrix(matrix)
    i, j = entries.row.astype(np.int64), entries.col.astype(np.int64)
    level, part = _separators(i, j, _bisect(positions, depth), depth)
    # Each front takes in the rows of its own unknowns; columns eliminated before are done with.
    later = level[j] <= level[i]
    i, j = i[later], j[later]
    data = np.where(free[i] & free[j], entries.data[later], 0.0)

    levels, place, slot, count = [], np.zeros(n, np.int32), np.zeros(n, np.int64), 0
    border, pushed = _Border.of(i[:0], i[:0], 2 << depth, n), np.zeros((2 << depth, 0, 0))
    for k in range(depth, -1, -1):
        parts, below = 1 << k, border
        mine = np.flatnonzero(level == k)
        slot[mine], s = _ranks(part[mine], parts)
        own = np.full((parts, s), n, np.int32)
        own[part[mine], slot[mine]] = mine
        place[mine] = count + part[mine] * s + slot[mine]
        count += own.size
        rows = np.flatnonzero(level[i] == k)
        rises, stays = rows[level[j[rows]] < k], level[below.vertex] < k
        border = _Border.of(
            np.concatenate([part[i[rises]], below.part[stays] // 2]),
            np.concatenate([j[rises], below.vertex[stays]]),
            parts,
            n,
        )
        size = s + border.width

        def stand(where, vertex, k=k, s=s, border=border):
            """Return where vertices stand in the fronts of some parts."""
            return np.where(level[vertex] == k, slot[vertex], s + border.find(where, vertex))

        # One row and column more than a front has take what pads the borders below.
        front = np.zeros((parts, size + 1, size + 1))
        here, row, column = part[i[rows]], slot[i[rows]], stand(part[i[rows]], j[rows])
        front[here, row, column] = data[rows]
        front[here, column, row] = data[rows]
        own[~np.append(free, False)[own]] = n
        lone, at = np.nonzero(own == n)
        front[lone, at, at] = 1.0
        above = np.full((2 * parts, below.width), size, np.int32)
        above[below.part, below.slot] = stand(below.part // 2, below.vertex)
        for side in (0, 1):
            to = above[side::2]
            front[np.arange(parts)[:, None, None], to[:, :, None], to[:, None]] += pushed[side::2]
        found = np.full((2 * parts, size + 1), below.width, np.int32)
        found[np.arange(2 * parts)[:, None], above] = np.arange(below.width, dtype=np.int32)

        half = np.linalg.inv(np.linalg.cholesky(front[:, :s, :s]))
        inverse = np.swapaxes(half, 1, 2) @ half
        outside = front[:, s:size, :s]
        coupling = outside @ inverse
        pushed = front[:, s:size, s:size] - coupling @ np.swapaxes(outside, 1, 2)
        levels.append((own, inverse, coupling, above, found[:, :size].reshape(parts, 2, size)))
    # What a level knows of the next one up was found there.
    above = [level[3] for level in levels[1:]] + [np.zeros((1, 0), np.int32)]
    return DissectedFactor(
        tuple(
            Level(
                own=jnp.asarray(own),
                inverse=jnp.asarray(inverse, dtype),
                coupling=jnp.asarray(coupling, dtype),
                above=jnp.asarray(up),
                below=jnp.asarray(down),
            )
            for (own, inverse, coupling, _, down), up in zip(levels, above, strict=True)
        ),
        jnp.asarray(place),
    )


def _bisect(positions: Float[np.ndarray, "n 3"], depth: int) -> Int[np.ndarray, "n"]:
    """Cut into 2^depth equal parts: each level in two, across the direction of largest spread.

    The bits of a label tell the sides, the first cut's in front. Against METIS's partition of the
    graph (recursive bisection) this stores 0.8 to 1.5 times as much, and needs no other library.
    """
    n = len(positions)
    label, order = np.zeros(n, np.int64), np.arange(n)
    # The squares below shall not overflow.
    positions = positions - positions.mean(axis=0)
    positions = positions / max(np.abs(positions).max(initial=0.0), np.finfo(float).tiny)
    for k in range(depth):
        sorted_label = label[order]
        first = np.searchsorted(sorted_label, np.arange(1 << k))
        count = np.diff(np.append(first, n))
        x = positions[order]
        x = x - (np.add.reduceat(x, first) / count[:, None])[sorted_label]
        spread = np.add.reduceat(x[:, :, None] * x[:, None], first)
        axis = np.linalg.eigh(spread)[1][:, :, -1]
        along = np.einsum("ni,ni->n", x, axis[sorted_label])
        order = order[np.lexsort((along, sorted_label))]
        second = np.arange(n) - first[sorted_label] >= (count // 2)[sorted_label]
        label[order] = 2 * sorted_label + second
    return label


def _separators(
    i: Int[np.ndarray, "entries"], j: Int[np.ndarray, "entries"], label, depth: int
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return for each unknown the level and the part that eliminates it.

    An edge that a cut goes through must have an end in the separator: the fewest such unknowns are
    a vertex cover.
    """
    level = np.full(len(label), depth)
    once = i < j
    i, j = i[once], j[once]
    for k in range(depth):
        left = (level[i] == depth) & (level[j] == depth)
        i, j = i[left], j[left]
        side_i, side_j = label[i] >> (depth - 1 - k), label[j] >> (depth - 1 - k)
        cut = (side_i != side_j) & (side_i >> 1 == side_j >> 1)
        swap = side_i[cut] > side_j[cut]
        one, two = np.where(swap, j[cut], i[cut]), np.where(swap, i[cut], j[cut])
        level[_vertex_cover(one, two)] = k
    return level, label >> (depth - level)


def _vertex_cover(one: Int[np.ndarray, "e"], two: Int[np.ndarray, "e"]) -> Int[np.ndarray, "c"]:
    """Return the fewest vertices that meet all edges of a bipartite graph (Koenig 1931).

    From the unmatched on the first side, along paths that alternate with the matching: the cover is
    what they do not reach there, and what they reach on the second side.
    """
    first, a = np.unique(one, return_inverse=True)
    second, b = np.unique(two, return_inverse=True)
    graph = sp.csr_matrix((np.ones(len(a), np.int8), (a, b)), shape=(len(first), len(second)))
    partner = maximum_bipartite_matching(graph, perm_type="column")
    matched = np.flatnonzero(partner >= 0)
    back = np.full(len(second), -1)
    back[partner[matched]] = matched
    reached, beyond = partner < 0, np.zeros(len(second), bool)
    new = reached.copy()
    while new.any():
        step = np.unique(b[new[a] & ~beyond[b]])
        beyond[step] = True
        new = np.zeros(len(first), bool)
        new[back[step]] = True  # all are matched, or the matching could grow
        new &= ~reached
        reached |= new
    return np.concatenate([first[~reached], second[beyond]])


class _Border(NamedTuple):
    """The borders of all parts of a level: for each entry its part, vertex and slot."""

    part: Int[np.ndarray, "entries"]
    vertex: Int[np.ndarray, "entries"]
    slot: Int[np.ndarray, "entries"]
    width: int
    key: Int[np.ndarray, "entries"]
    n: int

    @staticmethod
    def of(part, vertex, parts: int, n: int) -> "_Border":
        """Collect pairs of part and vertex, each once."""
        key = np.unique(part * n + vertex)
        part, vertex = np.divmod(key, n)
        return _Border(part, vertex, *_ranks(part, parts), key, n)

    def find(self, part, vertex):
        """Return the slots of vertices in the borders of parts; anything where there is none."""
        if not len(self.key):
            return np.zeros(len(part), np.int64)
        at = np.searchsorted(self.key, part * self.n + vertex)
        return self.slot[np.minimum(at, len(self.key) - 1)]


def _ranks(group: Int[np.ndarray, "m"], groups: int) -> tuple[Int[np.ndarray, "m"], int]:
    """Number the members of each group from 0; return also the size of the largest group."""
    size = np.bincount(group, minlength=groups)
    order = np.argsort(group, kind="stable")
    rank = np.empty(len(group), np.int64)
    rank[order] = np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)
    return rank, int(size.max(initial=0))
