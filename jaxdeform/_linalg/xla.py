"""Where XLA must be talked out of an optimisation: what it would do, and what that costs.

``lax.optimization_barrier`` leaves no trace in the optimised program of a CPU, so each of these
hides a fact from the compiler instead. tests/linalg/test_xla.py reads the compiled programs and
fails once XLA sees through one.
"""

from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdeform._arrays import is_concrete


def has_accelerator() -> bool:
    """Whether calls back to the host would cost more than the products that avoid them."""
    return jax.default_backend() != "cpu"


def total(x: Float[Array, "*shape"], batch: int | None = None) -> Float[Array, "*batch"]:
    """Return the sum of all entries, or of those of each batch member (the last part of an axis).

    The ``where`` changes nothing, but XLA does not know it. A plain sum would take the expression
    of x into itself, where a single thread works it out: 0.8 instead of 0.2 ms for the energy of
    51,200 cells.
    """
    x = jnp.where(jnp.isnan(x), jnp.nan, x)
    return jnp.sum(x) if batch is None else jnp.sum(x.reshape(-1, batch), axis=0)


def without_fusion(always: Bool[Array, ""], otherwise, function, *arguments):
    """Return ``function(*arguments)``, evaluated once.

    It is one branch of a ``cond`` that is always taken, which XLA cannot prove; ``otherwise`` has
    the shapes of the result. Without it XLA repeats the end of the function inside every
    expression that reads it: for QuasiNewton the sum that makes the gradient, 3 of the 7 ms of an
    iteration of 16 bars, and the solution of the cells inside the derivative to each input.
    """
    return jax.lax.cond(always, function, lambda *_: otherwise, *arguments)


def after_reads(
    condition: Bool[Array, "batch"], reads: Float[Array, "batch"]
) -> Bool[Array, "batch"]:
    """Return the condition for writing into an array, after numbers that were read from it.

    It is false where ``reads``, any sum of these numbers, is not finite. The write so depends on
    the reads, and XLA writes into the old array. Without it XLA keeps a copy of the array for the
    reads: an iteration of QuasiNewton takes 32 instead of 27 ms (50,298 vertices).
    """
    return condition & jnp.isfinite(reads)


# Two thirds of the time of compilation, and the same time of running.
AS_FAST = {"xla_cpu_use_fusion_emitters": False}
# Half the time of compilation, for 2 to 9 % of the time of running.
QUICK = {**AS_FAST, "xla_backend_optimization_level": 1}


def quick_jit(
    static: tuple[str, ...], options: Mapping[str, bool | int] = QUICK
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator like ``jax.jit``, for programs at top level: they compile sooner.

    Where this jaxlib does not know the options, or in another program, they compile as usual.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        inside = jax.jit(function, static_argnames=static)

        @cache
        def at_top() -> Callable[..., Any]:
            taken = _taken(tuple(options.items()))
            return jax.jit(function, static_argnames=static, compiler_options=taken)

        @wraps(function)
        def call(*arguments: Any, **settings: Any) -> Any:
            chosen = at_top() if _is_at_top(arguments) else inside
            return chosen(*arguments, **settings)

        return call

    return decorate


def _is_at_top(arguments: tuple[Any, ...]) -> bool:
    """Whether JAX is not tracing: it takes compiler options nowhere else."""
    return is_concrete(arguments, jnp.zeros(()))  # the last is traced inside jit


@cache
def _taken(options: tuple[tuple[str, bool | int], ...]) -> dict[str, bool | int] | None:
    chosen = dict(options)
    try:
        jax.jit(lambda x: x, compiler_options=chosen).lower(0.0).compile()
    except Exception:  # whatever this version raises for an option that it does not know
        return None
    return chosen
