"""The thesis's iteration: local step, global step (Sec. 4.1.1)."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdeform._checks import check_count, check_tolerance
from jaxdeform._deformation.adjoint import Unrolled
from jaxdeform._deformation.descent import Descent, Iterate
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.system import System
from jaxdeform._linalg.lbfgs import has_converged
from jaxdeform._result import Result


@dataclass(frozen=True)
class Alternating:
    """The thesis's iteration: local step, global step, a fixed number of times (Sec. 4.1.1).

    Each step lowers the energy (except with the normal term). Reaching the number is the normal
    end.

    **Fields**

    - steps: number of iterations, or the most of them where a tolerance is given.
    - tolerance: stop early once a step is expected to lower the energy by less than this fraction
      of it.
    - can_unroll, needs_one_energy: see `Solver`.
    - numbers: the fields whose change compiles nothing anew.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Alternating(steps=50).steps
        50
    """

    steps: int = 100
    tolerance: float | None = None

    can_unroll: ClassVar[bool] = True
    needs_one_energy: ClassVar[bool] = False
    numbers: ClassVar[dict[str, type]] = {"tolerance": float}

    def __post_init__(self) -> None:
        """Check the settings."""
        check_count("steps of Alternating", self.steps)
        if self.tolerance is not None:
            check_tolerance("tolerance of Alternating", self.tolerance)

    @property
    def default_adjoint(self) -> Unrolled:
        """Unrolled: exact for the number of steps taken."""
        return Unrolled()

    def minimize(
        self,
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> Descent:
        """Iterate as a scan, which both modes of differentiation can go through."""

        @jax.checkpoint
        def step(p, is_last):
            # Kept for the backward pass: one p a step. All else is computed again there.
            at = energy.evaluate(system, inputs, p)
            move = system.factor.solve(at.gradient)
            # A cell without a solution would spread to all others. So the last finite p stays, and
            # only such cells have transforms that are NaN.
            done = is_last | jnp.isnan(at.energy)
            if self.tolerance is not None:
                gain = jnp.sum(at.gradient * move)
                done |= has_converged(gain, at.energy, at.rounding, self.tolerance)
            # A^-1 K^T T as a correction of p, so that rounding errors do not accumulate.
            return jnp.where(done, p, p - move), at.transforms, at.energy, done

        def advance(state: Iterate, index) -> Iterate:
            p, transforms, value, done = step(state.p, index == self.steps)
            return Iterate(p, transforms, value, done, state.steps + jnp.where(done, 0, 1))

        def body(state: Iterate, index):
            if self.tolerance is None:
                state = advance(state, index)
            else:
                state = jax.lax.cond(state.done, lambda s, _: s, advance, state, index)
            return state, state.energy

        # One iteration more than steps: the last one evaluates the end, so that the local step is
        # compiled once.
        end, history = jax.lax.scan(
            body, Iterate.before(start), jnp.arange(self.steps + 1, dtype=jnp.int32)
        )
        result = Result.steps_done
        if self.tolerance is not None:
            result = Result.where(end.steps < self.steps, Result.converged, Result.step_limit)
        return Descent(end.p, end.transforms, history, end.steps, result)
