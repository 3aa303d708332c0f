"""How derivatives are made: through the iterations, or from the fixed point alone."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdeform._checks import check_count, check_flag, check_tolerance
from jaxdeform._deformation.descent import Anchor, Descent, Solver
from jaxdeform._deformation.metric import apply_metric, metric_of
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.system import System
from jaxdeform._errors import InputError
from jaxdeform._linalg.conjugate_gradients import conjugate_gradients, dot
from jaxdeform._linalg.known_value import with_derivative_of
from jaxdeform._linalg.newton import STEP_TOLERANCE, HessianSolver, Step, to_minimum


@dataclass(frozen=True)
class Unrolled:
    """Differentiate through the iterations, which are recomputed step by step (checkpointed).

    Exact for the number of steps taken, converged or not. Memory grows by one mesh a step.

    **Fields**

    - needs_one_energy: see `Adjoint`.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Unrolled()
        Unrolled()
    """

    needs_one_energy: ClassVar[bool] = False

    def check(self, solver: Solver) -> None:
        """Raise InputError if the solver's loop has no reverse mode."""
        if not solver.can_unroll:
            raise InputError(
                "Unrolled() differentiates the thesis's iterations: use it with "
                f"solver=Alternating(), or Implicit() with {type(solver).__name__}()"
            )

    def solve(
        self,
        solver: Solver,
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> tuple[Descent, Anchor]:
        """Run the solver; JAX differentiates its loop."""
        end = solver.minimize(energy, system, inputs, start)
        return end, Anchor(end.positions, end.transforms)


@dataclass(frozen=True)
class Implicit:
    """Differentiate the fixed point instead of the path: memory independent of the step count.

    The implicit function theorem on grad E(p) = 0 gives ``H dp = -(d grad E / d inputs) dinputs``.
    The Hessian H = A - K^T dT/dC K is symmetric, so one conjugate gradient method serves forward
    and reverse mode. Its preconditioner is the metric of ``QuasiNewton()``.

    It is taken at the minimum next to the state, because the error of a derivative is many times
    that of the state. At the state of ``QuasiNewton()`` itself a gradient was up to 2.6 % off. One
    Newton step further that of a stiff bar was still 5 % off. Newton's method goes on until the
    error is below 1e-5, mostly for two steps (docs/derivatives.md has the table).

    Where the minimum is not found or the linear system not solved, the derivative is NaN, not a
    wrong number: the state is at a saddle or far from converged, or ``max_steps`` is too low.

    **Fields**

    - tolerance: relative residual of the linear system (but no less than the precision allows).
    - max_steps: most steps of conjugate gradients.
    - throw: raise an error, also inside jit, instead of returning NaN.
    - needs_one_energy: see `Adjoint`.
    - numbers: the fields whose change compiles nothing anew.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Implicit(tolerance=1e-6).max_steps
        500
    """

    tolerance: float = 1e-10
    max_steps: int = 500
    throw: bool = False

    needs_one_energy: ClassVar[bool] = True
    numbers: ClassVar[dict[str, type]] = {"tolerance": float, "max_steps": int}

    def __post_init__(self) -> None:
        """Check the settings."""
        check_tolerance("tolerance of Implicit", self.tolerance)
        check_count("max_steps of Implicit", self.max_steps)
        check_flag("throw of Implicit", self.throw)

    def check(self, solver: Solver) -> None:
        """Accept every solver."""

    def solve(
        self,
        solver: Solver,
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> tuple[Descent, Anchor]:
        """Run the solver on constants, and give its end the derivative of the fixed point."""
        known = inputs._replace(geometry=None)
        end = solver.minimize(energy, *jax.lax.stop_gradient((system, known, start)))
        end = jax.lax.stop_gradient(end)
        state = end.positions, end.transforms
        p, anchor = self.minimum(energy, system, inputs, *state)
        return end._replace(positions=p), anchor

    def minimum(self, energy: ReducedEnergy, system, inputs, p, transforms):
        """Return p, known to be near the minimiser for these inputs, with the derivatives of that.

        If any derivative is asked for, p moves to the minimum, and the derivatives are taken there;
        they need that place as well.

        (lax.custom_root would do it too, but it traces the derivatives even where nobody asks for
        any: 0.7 s.)
        """

        @jax.custom_jvp
        def minimiser(system, inputs, p, transforms, tolerance, max_steps):
            del system, inputs, tolerance, max_steps
            return p, Anchor(p, transforms)

        @minimiser.defjvp
        def minimiser_jvp(primals, tangents):
            system, inputs, state, _, tolerance, max_steps = primals
            known, _ = minimiser(*primals)  # so that this rule has derivatives too
            metric = metric_of(system, energy.local, inputs.rigidity)
            precondition = lambda x: apply_metric(system, metric, x) + system.at_fixed(x)  # noqa: E731
            (p, transforms), found = _to_minimum(
                energy, system, inputs, precondition, state, max_steps
            )
            solver = HessianSolver(precondition, found, tolerance, max_steps, self.throw)
            p = p + known - jax.lax.stop_gradient(known)

            def gradient(free, inputs):
                moved = jnp.where(system.free[None], free, inputs.targets)
                return energy.evaluate(system, inputs, moved, transforms).gradient

            def newton(p, inputs):
                slope, hessian = _slope_and_hessian(system, lambda x: gradient(x, inputs), p)
                step = solver.solve(hessian, -slope)
                return jnp.where(system.free[None], p + step, inputs.targets)

            # A Newton step of size 0, whose derivatives need no rule.
            p = with_derivative_of(newton, p, p, inputs)
            _, hessian = _slope_and_hessian(system, lambda x: gradient(x, inputs), p)
            _, right = jax.jvp(lambda inputs: gradient(p, inputs), (inputs,), (tangents[1],))
            move = solver.solve(hessian, -right)
            move = jnp.where(system.free[None], move, tangents[1].targets)
            moves = move, Anchor(move, jnp.zeros_like(transforms))
            return (p, Anchor(p, transforms)), moves

        return minimiser(system, inputs, p, transforms, self.tolerance, self.max_steps)


def _to_minimum(energy: ReducedEnergy, system, inputs, precondition, p, max_steps):
    """Return the minimum next to p, the transformations there, and whether it was found.

    By Newton's method. The transformations follow its last step to first order.
    """
    known = inputs._replace(geometry=None)
    system, inputs, p = jax.lax.stop_gradient((system, known, p))

    def evaluate(x):
        at = energy.evaluate(system, inputs, x)
        return (at.gradient, at.transforms), at

    def step(state):
        p, _ = state
        (gradient, transforms), linear, at = jax.linearize(evaluate, p, has_aux=True)
        move, left = conjugate_gradients(
            lambda x: linear(x)[0] + system.at_fixed(x),
            precondition,
            -gradient,
            STEP_TOLERANCE,
            max_steps,
        )
        moved = p + move, transforms + linear(move)[1]
        return Step(moved, left, -dot(gradient, move), at.energy, at.rounding)

    return to_minimum(step, (p, jnp.zeros((3, *p.shape), p.dtype)))


def _slope_and_hessian(system: System, gradient, p):
    """Return the gradient at p, and the Hessian as a function; the identity for fixed vertices."""
    slope, linear = jax.linearize(gradient, p)
    return slope, lambda x: linear(x) + system.at_fixed(x)
