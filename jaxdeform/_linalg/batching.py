"""What the rules for vmap have in common. Mostly one system serves all members of a batch."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def is_shared(batched: Any) -> bool:
    """Whether nothing of an argument is batched, given the flags of ``custom_vmap``."""
    return not any(jax.tree.leaves(batched))


def spread_over_members(size: int, batched: Any, own: Any) -> Any:
    """Return ``own`` with a first axis of members everywhere, for a rule of ``custom_vmap``."""

    def spread(x, is_batched):
        return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

    return jax.tree.map(spread, own, batched)


def one_by_one(
    function: Callable[..., Any], size: int, batched: Any, arguments: tuple[Any, ...]
) -> tuple[Any, Any]:
    """Run a function on each member in turn: the rule where each has a system of its own.

    Side by side the matrices of all would be read in turn anyhow, and all would wait for the
    slowest.
    """
    own = spread_over_members(size, tuple(batched), arguments)
    out = jax.lax.map(lambda one: function(*one), own)
    return out, jax.tree.map(lambda _: True, out)
