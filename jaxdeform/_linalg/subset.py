"""Run a function only on the few cells that need it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxdeform._linalg.varying import as_varying

# Up to this many cells, gathering the few would cost more compile time than it saves.
SMALL = 2000


def on_few(solve, waiting: Bool[Array, "cells"], size: int, x, *data):
    """Replace x by ``solve(x, *data)`` in the waiting cells, ``size`` cells at a time.

    Usually no cell waits, and nothing runs. In all arrays the cells are the last axis.
    """
    n = waiting.shape[0]
    x, waiting = as_varying((x, waiting), data)
    if size >= n:
        # A loop instead of a cond, because under vmap a cond always runs, for the whole batch.
        put = lambda old, new: jnp.where(waiting, new, old)  # noqa: E731

        def once(state):
            x, again = state
            return jax.tree.map(put, x, solve(x, *data)), jnp.zeros_like(again)

        return jax.lax.while_loop(lambda state: state[1], once, (x, jnp.any(waiting)))[0]

    def advance(state):
        x, waiting = state
        (chosen,) = jnp.nonzero(waiting, size=size, fill_value=n)
        pick = lambda v: v.at[..., chosen].get(mode="clip")  # noqa: E731
        put = lambda old, new: old.at[..., chosen].set(new, mode="drop")  # noqa: E731
        x = jax.tree.map(put, x, solve(*jax.tree.map(pick, (x, *data))))
        return x, put(waiting, jnp.zeros(chosen.shape, bool))

    return jax.lax.while_loop(lambda state: jnp.any(state[1]), advance, (x, waiting))[0]
