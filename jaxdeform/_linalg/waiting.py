"""Waiting for arrays in Python, where Ctrl-C is heard."""

import time
from typing import TypeVar

import jax

Tree = TypeVar("Tree")

# While JAX waits, Python's signal handlers do not run. So ask now and then instead: after 3 % of
# the time waited so far, which adds half of that to it, but every 5 ms at least.
_SHARE, _SHORTEST, _LONGEST = 0.03, 2e-5, 5e-3


def wait_for(tree: Tree) -> Tree:
    """Return the arrays of a tree once they are there.

    JAX hands out arrays before they are computed. Whoever then reads one waits inside JAX, and a
    Ctrl-C is heard when all is over: 91 s later, for 800 steps on 100,489 vertices.
    """
    began = time.perf_counter()
    for leaf in jax.tree.leaves(tree):
        # Every array that is no tracer has is_ready; the abstract class does not name it.
        ready = getattr(leaf, "is_ready", lambda: True)
        while not ready():
            waited = time.perf_counter() - began
            time.sleep(min(max(_SHARE * waited, _SHORTEST), _LONGEST))
    return tree
