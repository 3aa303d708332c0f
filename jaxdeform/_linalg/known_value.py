"""A known value that has the derivatives of a function, by ordinary rules of JAX alone."""

from collections.abc import Callable
from typing import Any

import jax
from jax.flatten_util import ravel_pytree


def with_derivative_of(function: Callable[..., Any], known: Any, *arguments: Any) -> Any:
    """Return ``known``, which is ``function(*arguments)``, with the derivatives of that.

    The function is traced, but runs only where a derivative needs it. A ``custom_jvp`` would do the
    same, but reverse mode through a scan drops the rule of what depends on its carry or its slices
    (jax 0.10), and a second derivative then takes the value for a constant, without a word.

    It is the solution x of ``x + known - function(*arguments) = known``, whose solver returns the
    right-hand side. JAX derives the equation, not the solver, so what ``known`` depends on by
    itself does not count.
    """
    flat, as_it_was = ravel_pytree(known)

    def equation(x):
        return x + flat - ravel_pytree(function(*arguments))[0]

    solution = jax.lax.custom_linear_solve(equation, flat, lambda _, b: b, symmetric=True)
    return as_it_was(solution)
