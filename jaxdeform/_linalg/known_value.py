"""A known value that has the derivatives of a function, by ordinary rules of JAX alone."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxdeform._errors import InputError

Known = TypeVar("Known")


def with_derivative_of(function: Callable[..., Known], known: Known, *arguments: Any) -> Known:
    """Return ``known``, which is ``function(*arguments)``, with the derivatives of that.

    For what has been found in another way, as a minimum by iterations: the function may be one
    Newton step from it. It runs only where a derivative needs it, in any order of forward and
    reverse mode, also inside a scan. What ``known`` depends on by itself does not count.

    A ``custom_jvp`` would do the same, but reverse mode through a scan drops the rule of what
    depends on its carry or its slices (jax 0.10), and a second derivative then takes the value for
    a constant, without a word.

    It is the solution of a linear system, whose solver returns the right-hand side, because
    ``function(*arguments) - known`` is 0. JAX differentiates the equations, not the solver:

        [ I   known - function(*arguments) ] [x]   [known]
        [ 0                1               ] [1] = [  1  ].

    **Arguments**: function, differentiable, of arrays or pytrees of them; known, an array or a
    pytree of arrays, of the shapes and types that it returns; arguments, those of the function.
    **Returns** known. **Raises** InputError if function is none, or returns something else.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxdeform as jd
        >>> def root(x):
        ...     return jd.with_derivative_of(jnp.sqrt, jnp.asarray(1.5), x)
        >>> float(root(2.25)), round(float(jax.grad(root)(2.25)), 6)
        (1.5, 0.333333)
    """
    if not callable(function):
        raise InputError(f"function is a {type(function).__name__}: give what can be called")
    wanted = _kinds("known", known)
    flat, as_it_was = ravel_pytree(known)

    def product(z):
        value = function(*arguments)
        returned = _kinds("the value of function", value)
        if returned != wanted:
            raise InputError(f"known is {wanted}, but function returns {returned}")
        x, one = z[:-1], z[-1:]
        return jnp.append(x + one * (flat - ravel_pytree(value)[0]), one)

    def solve(_, right):
        return right

    solution = jax.lax.custom_linear_solve(product, jnp.append(flat, 1.0), solve, solve)
    return as_it_was(solution[:-1])


def _kinds(name: str, value: Any) -> Any:
    """Return the shape and type of every array, or raise InputError: one is no floating array."""

    def kind(x):
        if not isinstance(x, jax.Array | np.ndarray | float | np.floating):
            raise InputError(f"{name} holds a {type(x).__name__}: give arrays of floating numbers")
        if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
            raise InputError(f"{name} is of {jnp.result_type(x)}: give floating numbers")
        return f"{jnp.result_type(x)}{list(jnp.shape(x))}"

    return jax.tree.map(kind, value)
