"""Two labels over a graph at the least cost: a minimum cut (Greig, Porteous and Seheult 1989)."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

# SciPy's flows are 32-bit integers: all capacities together are this many units.
_UNITS = 1e9


def cheapest_side(
    gain: Float[np.ndarray, "nodes"],
    edges: Int[np.ndarray, "edges 2"],
    price: Float[np.ndarray, "edges"],
) -> Bool[np.ndarray, "nodes"]:
    """Return which nodes to choose, so that their gains minus the price of the border are largest.

    An edge costs its price (0 or more) if one of its ends is chosen. Of equal choices, it is that
    of the fewest nodes, whatever their order.
    """
    n = len(gain)
    # More than all its edges cost decides a node, however much more: then the units go round.
    around = sum(np.bincount(end, price, n) for end in edges.T)
    gain = np.clip(gain, -2.0 * around - price.mean(), 2.0 * around + price.mean())
    source, sink, nodes = n, n + 1, np.arange(n)
    i, j = edges.T
    rows = np.concatenate([i, j, np.full(n, source), nodes])
    columns = np.concatenate([j, i, nodes, np.full(n, sink)])
    capacity = np.concatenate([price, price, np.maximum(gain, 0.0), np.maximum(-gain, 0.0)])
    capacity = np.round(capacity * (_UNITS / max(capacity.sum(), 1e-300))).astype(np.int32)
    graph = sp.csr_matrix((capacity, (rows, columns)), shape=(n + 2, n + 2))
    left = graph - sp.csgraph.maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    chosen = np.zeros(n + 2, bool)
    chosen[sp.csgraph.breadth_first_order(left, source, return_predecessors=False)] = True
    return chosen[:n]
