"""What the rules for vmap have in common. Mostly one system serves all members of a batch."""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.experimental.custom_partitioning import custom_partitioning
from jax.sharding import NamedSharding, PartitionSpec

from jaxdeform._linalg.ffi import installed_interface
from jaxdeform._linalg.xla import has_accelerator


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
    out = side_by_side(lambda _, own: jax.lax.map(lambda one: function(*one), own), (), own)
    return out, jax.tree.map(lambda _: True, out)


def side_by_side(function: Callable[[Any, Any], Any], shared: Any, own: Any) -> Any:
    """Return ``function(shared, own)``, where members are the first axis of ``own`` and result.

    Under vmap over ``own`` there are only more members. In a program whose members are sharded over
    devices, each device works off its own: XLA by itself would gather whatever goes through a loop
    or to the host, and do the work of all on every device. That is left to it where the host is
    called by ``jax.pure_callback`` (host_call.py), which crashes in a divided program (jax 0.10).
    """

    @custom_vmap
    def run(shared, own):
        members = jax.tree.leaves(own)[0].shape[0]
        if members == 1 or installed_interface() is None or has_accelerator():
            return function(shared, own)
        try:
            return _divided(function, shared)(shared, own)
        except AssertionError:  # JAX divides no function that has captured an array
            return function(shared, own)

    @run.def_vmap
    def run_more(size, is_batched, shared, own):
        if not is_shared(is_batched[0]):
            return one_by_one(run, size, is_batched, (shared, own))
        own = spread_over_members(size, is_batched[1], own)
        each = jax.tree.leaves(own)[0].shape[1]
        flat = jax.tree.map(lambda x: x.reshape(size * each, *x.shape[2:]), own)
        out = run(shared, flat)
        out = jax.tree.map(lambda x: x.reshape(size, each, *x.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return run(shared, own)


def as_member(function: Callable[[Any, Any], Any], shared: Any, own: Any) -> Any:
    """Return ``function(shared, own)`` of one member, which has no axis of members.

    Under vmap the function gets all members, by `side_by_side`.
    """
    out = side_by_side(function, shared, jax.tree.map(lambda x: x[None], own))
    return jax.tree.map(lambda x: x[0], out)


def _divided(function: Callable[[Any, Any], Any], shared: Any) -> Callable[[Any, Any], Any]:
    """Return the function for XLA to divide between devices, by members and by nothing else."""
    run = custom_partitioning(function)
    n_shared = len(jax.tree.leaves(shared))

    def rule(_mesh: Any, operands: Any, results: Any) -> tuple[str, dict[str, Any]]:
        """Name the axes, as in an einsum; only that of the members has a name that comes twice."""
        names = (f"axis_{i}" for i in itertools.count())
        whole: list[str] = []

        def axes(count: int) -> list[str]:
            new = list(itertools.islice(names, count))
            whole.extend(new)
            return new

        before = [" ".join(axes(x.rank)) for x in operands[:n_shared]]
        before += [" ".join(["members", *axes(x.rank - 1)]) for x in operands[n_shared:]]
        after = [" ".join(["members", *axes(x.rank - 1)]) for x in results]
        text = f"{', '.join(before)} -> {', '.join(after)}"
        return text, {"need_replication_factors": tuple(whole)}

    def partition(mesh: Any, arguments: Any, results: Any) -> tuple[Any, ...]:
        members = jax.tree.leaves(results)[0].sharding.spec[0]
        whole = NamedSharding(mesh, PartitionSpec())
        part = NamedSharding(mesh, PartitionSpec(members))
        places = (
            jax.tree.map(lambda _: whole, arguments[0]),
            jax.tree.map(lambda _: part, arguments[1]),
        )
        return mesh, function, jax.tree.map(lambda _: part, results), places

    run.def_partition(partition, sharding_rule=rule)
    return run
