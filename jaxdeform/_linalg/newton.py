"""Newton's method, from a state to the minimum next to it, where derivatives are right.

Each step is solved to `STEP_TOLERANCE` of it: 1e-3 gains nothing, 1e-1 leaves four times the error
(bar, rigidity 0.05 and 5, state of tolerance 1e-6: gradient off by 1.2e-2 without a step, after one
by 1.4e-4, 3.8e-5 and 2.0e-5 with 1e-1, 1e-2 and 1e-3).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._linalg.conjugate_gradients import Vectors, conjugate_gradients
from jaxdeform._linalg.varying import as_varying

STEP_TOLERANCE = 1e-2
# The last step gains less than this fraction of the energy. The gradient of the bar (bends, twist,
# stretch; constants 1e-4 to 100) is then right to 5e-7 from states of tolerance 1e-8, to 2e-6 from
# those of 1e-2; after one step alone to 5e-2 and not at all. With 1e-8 the second is 6e-3.
_GAIN = 1e-9
_MOST_STEPS = 8


class Step(NamedTuple):
    """One step of Newton's method."""

    state: Any
    """After it."""
    left: Float[Array, ""]
    """What is left of its linear system, relative."""
    gain: Float[Array, ""]
    """By how much it lowers the energy, were that quadratic."""
    energy: Float[Array, ""]
    """Before it."""
    rounding: Float[Array, ""]
    """The rounding error of the energy."""


def to_minimum(take: Callable[[Any], Step], state: Any) -> tuple[Any, Bool[Array, ""]]:
    """Return the minimum next to a state, and whether it was found.

    Without derivatives: ``jax.lax.while_loop`` has no reverse mode.
    """

    def body(carry):
        count, _, old = carry
        step = take(old)
        solved = step.left <= STEP_TOLERANCE  # NaN is not
        found = solved & (jnp.abs(step.gain) <= _GAIN * jnp.abs(step.energy) + step.rounding)
        state = jax.tree.map(lambda new, old: jnp.where(solved, new, old), step.state, old)
        return jnp.where(solved, count + 1, _MOST_STEPS), found, state

    def far(carry):
        count, found, _ = carry
        return ~found & (count < _MOST_STEPS)

    begin = jnp.zeros((), jnp.int32), jnp.asarray(False), state
    _, found, state = jax.lax.while_loop(far, body, as_varying(begin))
    return state, found


class HessianSolver(NamedTuple):
    """Linear systems with the Hessian at a minimum, by conjugate gradients."""

    precondition: Callable[[Vectors], Vectors]
    found: Bool[Array, ""]
    """Whether the minimum was found; if not, no derivative there is right."""
    tolerance: float | Float[Array, ""]
    """Relative residual, but no less than the precision allows."""
    max_steps: int | Int[Array, ""]
    throw: bool = False
    """Raise an error, also inside jit, instead of returning NaN."""

    def solve(self, hessian: Callable[[Vectors], Vectors], right: Vectors) -> Vectors:
        """Return the solution, which has derivatives; NaN where it was not found."""
        # All that the system reads is cast here. Transposed, it is cast as a whole, and a cast
        # within would be a second one.
        tolerance, max_steps, found = as_varying(
            (self.tolerance, self.max_steps, self.found), right
        )
        tolerance = jnp.maximum(tolerance, 20 * float(jnp.finfo(right.dtype).eps))
        accepted = jnp.maximum(100.0 * tolerance, 1e-6)
        accepted = jnp.minimum(accepted, jnp.maximum(1e-2, 2.0 * tolerance))

        def solve(multiply, right):
            solution, left = conjugate_gradients(
                multiply, self.precondition, right, tolerance, max_steps
            )
            unsolved = ~(found & (left <= accepted))
            if self.throw:
                return eqx.error_if(solution, unsolved, _UNSOLVED)
            return jnp.where(unsolved, jnp.nan, solution)

        return jax.lax.custom_linear_solve(hessian, right, solve, symmetric=True)


_UNSOLVED = (
    "the derivative is unknown: the minimum was not found, or conjugate gradients did not solve "
    "their linear system. The state is at a saddle or far from converged (lower the tolerance of "
    "the solver), or Implicit needs more max_steps"
)
