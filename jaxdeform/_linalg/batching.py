"""What the rules for vmap have in common, where one system serves all members of a batch."""

from typing import Any

import jax
import jax.numpy as jnp


def spread_over_members(size: int, system_batched: Any, own_batched: Any, own: Any) -> Any:
    """Return ``own`` with a first axis of members everywhere, for a rule of ``custom_vmap``.

    **Raises** NotImplementedError if the system itself is batched.
    """
    if any(jax.tree.leaves(system_batched)):
        raise NotImplementedError("vmap over problems: they differ in structure; use a loop")

    def spread(x, is_batched):
        return x if is_batched else jnp.broadcast_to(x, (size, *x.shape))

    return jax.tree.map(spread, own, own_batched)
