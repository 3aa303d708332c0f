"""Which cells leave the energy without a lower bound, and what is done about it.

An edge has a negative cotangent weight if its opposite angles sum to more than 180 degrees. Such a
weight rewards a stretch of its edge. This is the policy for negative weights:

- They are kept where the other edges of every cell outweigh them. A is then the exact Dirichlet
  energy, and the engine agrees with other ARAP programs.
- In every cell whose energy has no lower bound they count as 0 (``precompute``, with a warning
  that names the cells). Raising a weight raises the energy, so this harms no other cell.
- Where A is singular even so, ``precompute`` replaces all weights by
  `lifted_weights`, with a warning. The smoothness prior of estimation always uses lifted weights:
  with a negative weight it would reward a difference across the edge.

Without a lower bound are, with rings of r = 1, 27 of 502 cells of a decimated knight, 132 of 2,046
of a finger, 33 of 10,173 of an octopus, none of five other real meshes; with spokes nearly every
cell with a negative edge. 10,000 vertices take 0.1 s, with r = 2 0.3 s.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxdeform._mesh.cells import Cells

# Eigenvalues above this fraction of the largest weight (or moment) count as 0.
_ROUNDING = 1e-9

# Cells are checked together, as many as have this many matrix entries.
_AT_ONCE = 1 << 22


def bounded_cells(cells: Cells) -> tuple[Cells, Int[np.ndarray, "bad"]]:
    """Return cells whose energy has a lower bound for every rigidity >= 0, and the bad cells.

    The bad cells are those that had none; their negative weights are now 0.
    """
    bad = unbounded_cells(cells)
    if not bad.size:
        return cells, bad
    touched = np.unique(cells.membership[bad].indices)
    weights = cells.weights.copy()
    weights[touched] = np.maximum(weights[touched], 0.0)
    return dataclasses.replace(cells, weights=weights), bad


def unbounded_cells(cells: Cells) -> Int[np.ndarray, "bad"]:
    """Return the cells whose energy has no lower bound at rigidity 0.

    At rigidity 0 the best T is known (T B = C^T), and leaves ``tr(p^T M p)`` with
    ``M = L - K^T B^-1 K``, L the Laplacian of the cell. A cell is bounded if M has no negative
    eigenvalue. Rigidity only adds to the energy. Without a negative weight the energy is a sum of
    squares, so only cells with one are looked at.
    """
    negative = np.flatnonzero(cells.weights < 0)
    suspects = np.unique(cells.membership[:, negative].nonzero()[0])
    if not suspects.size:
        return suspects
    reach = cells.reach[suspects]
    sizes = np.diff(reach.indptr)
    bad = []
    for size in np.unique(sizes):
        alike = suspects[sizes == size]
        for part in np.array_split(alike, -(-len(alike) * size**2 // _AT_ONCE)):
            bad.append(part[_lowest_curvature(cells, part, int(size)) < -_ROUNDING])
    return np.sort(np.concatenate(bad))


def _lowest_curvature(
    cells: Cells, which: Int[np.ndarray, "cells"], size: int
) -> Float[np.ndarray, "cells"]:
    """Return the lowest eigenvalue of M of cells with this many vertices, over their weights."""
    count, n = len(which), cells.n_vertices
    member = cells.membership[which]
    row = np.repeat(np.arange(count), np.diff(member.indptr))
    i, j = cells.edges[member.indices].T
    w = cells.weights[member.indices]
    # The vertices of a cell, numbered from 0.
    keys = np.unique(np.concatenate([row * n + i, row * n + j]))
    first = np.searchsorted(keys, np.arange(count) * n)
    i, j = (np.searchsorted(keys, row * n + end) - first[row] for end in (i, j))
    laplacian = np.zeros((count, size, size))
    for a, b, value in ((i, i, w), (j, j, w), (i, j, -w), (j, i, -w)):
        np.add.at(laplacian, (row, a, b), value)
    points = np.zeros((count, size, 3))
    points[keys // n, np.arange(len(keys)) - first[keys // n]] = cells.mesh.vertices[keys % n]
    points -= points[:, :1]
    pull = laplacian @ points  # K^T of the cell
    moments, axes = np.linalg.eigh(np.swapaxes(points, 1, 2) @ pull)
    pull = pull @ axes
    largest = np.abs(moments).max(axis=1, keepdims=True)
    flat = np.abs(moments) <= _ROUNDING * largest
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, moments))
    form = laplacian - (pull * inverse[:, None]) @ np.swapaxes(pull, 1, 2)
    weight = np.zeros(count)
    np.maximum.at(weight, row, np.abs(w))
    lowest = np.linalg.eigvalsh(form)[:, 0] / weight
    # B itself must not be negative, and a direction without a moment must have no pull.
    slope = np.where(flat, (pull**2).sum(axis=1), 0.0).max(axis=1)
    wrong = (moments[:, 0] < -_ROUNDING * largest[:, 0]) | (
        slope > _ROUNDING * weight * largest[:, 0]
    )
    return np.where(wrong, -np.inf, lowest)
