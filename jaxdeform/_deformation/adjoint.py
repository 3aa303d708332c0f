"""How derivatives are made: through the iterations, or from the fixed point alone."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdeform._checks import check_count, check_tolerance
from jaxdeform._deformation.descent import Descent, Solver
from jaxdeform._deformation.problem import System
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._errors import InputError


@dataclass(frozen=True)
class Unrolled:
    """Differentiate through the iterations, which are recomputed step by step (checkpointed).

    Exact for the number of steps taken, converged or not. Memory grows by one mesh a step. Second
    derivatives are right by forward mode taken twice, wrong by forward over reverse mode
    (docs/derivatives.md): prefer :class:`Implicit` for a Hessian.

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
    ) -> Descent:
        """Run the solver; JAX differentiates its loop."""
        return solver.minimize(energy, system, inputs, start)


@dataclass(frozen=True)
class Implicit:
    """Differentiate the fixed point instead of the path: memory independent of the step count.

    Right once the iteration has converged. The implicit function theorem on grad E(p) = 0 gives
    ``H dp = -(d grad E / d inputs) dinputs``. The Hessian H = A - K^T dT/dC K is symmetric, so one
    conjugate gradient method, preconditioned with the factor of A, serves forward and reverse mode.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Implicit(tolerance=1e-6).max_steps
        500
    """

    tolerance: float = 1e-10
    """Relative residual of the linear system (but no less than the precision allows)."""
    max_steps: int = 500
    """Most steps of conjugate gradients."""

    needs_one_energy: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_tolerance("tolerance of Implicit", self.tolerance)
        check_count("max_steps of Implicit", self.max_steps)

    def check(self, solver: Solver) -> None:
        """Accept every solver."""

    def solve(
        self,
        solver: Solver,
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> Descent:
        """Run the solver on constants, and give its end the derivative of the fixed point."""
        end = solver.minimize(energy, *jax.lax.stop_gradient((system, inputs, start)))
        end = jax.lax.stop_gradient(end)
        p = self._with_implicit_derivative(energy, system, inputs, end.positions, end.transforms)
        return end._replace(positions=p)

    def _with_implicit_derivative(self, energy: ReducedEnergy, system, inputs, p, transforms):
        """Return p, known to be the minimiser for these inputs, with the derivatives of that.

        (lax.custom_root would do it too, but it traces the derivatives even where nobody asks for
        any: 0.7 s.)
        """

        @jax.custom_jvp
        def minimiser(system, inputs, p, transforms):
            del system, inputs, transforms
            return p

        @minimiser.defjvp
        def minimiser_jvp(primals, tangents):
            system, inputs, p, transforms = primals
            p = minimiser(system, inputs, p, transforms)  # so that this rule has derivatives too

            def gradient(free, inputs):
                moved = jnp.where(system.free[None], free, inputs.targets)
                return energy.evaluate(system, inputs, moved, transforms).gradient

            _, hessian = jax.linearize(lambda x: gradient(x, inputs), p)
            _, right = jax.jvp(lambda inputs: gradient(p, inputs), (inputs,), (tangents[1],))
            move = self._solve_hessian(system, hessian, -right)
            return p, jnp.where(system.free[None], move, tangents[1].targets)

        return minimiser(system, inputs, p, transforms)

    def _solve_hessian(self, system: System, hessian, right):
        def keep(x):  # the unknowns are the free vertices; elsewhere the system is the identity
            return jnp.where(system.free[None], 0.0, x)

        def conjugate_gradients(matvec, b):
            tolerance = max(self.tolerance, 20 * float(jnp.finfo(b.dtype).eps))
            precondition = lambda r: system.factor.solve(r) + keep(r)  # noqa: E731
            solution, _ = jax.scipy.sparse.linalg.cg(
                matvec, b, tol=tolerance, maxiter=self.max_steps, M=precondition
            )
            return solution

        return jax.lax.custom_linear_solve(
            lambda x: hessian(x) + keep(x), right, conjugate_gradients, symmetric=True
        )
