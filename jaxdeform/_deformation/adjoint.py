"""How derivatives go through the iterations: unrolled, or by the implicit function theorem."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from jaxdeform._deformation.alternating import alternate
from jaxdeform._deformation.problem import System
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.reduced_energy import Held, evaluate_lanes
from jaxdeform._linalg.lbfgs import Settings, minimize


@dataclass(frozen=True)
class Unrolled:
    """Differentiate through the iterations, which are recomputed step by step (checkpointed).

    Exact for the number of steps taken, converged or not; memory grows by one mesh a step.
    """


@dataclass(frozen=True)
class Implicit:
    """Differentiate the fixed point instead of the path: memory independent of the step count.

    Right once the iteration has converged. The linear system is solved by conjugate gradients,
    preconditioned with the factor of A that is there already.
    """

    tolerance: float = 1e-10
    """Relative residual of the linear system (no less than the precision allows)."""
    max_steps: int = 500


def solve_implicit(system: System, held: Held, p, evaluate, solver, adjoint: Implicit):
    """Solve by any method, and differentiate grad E(p) = 0 at the end (implicit function).

    ``H dp = -(d grad E / d held) dheld``. The Hessian H = A - K^T dT/dC K is symmetric, so the same
    conjugate gradients serve jvp and vjp. (lax.custom_root would do it too, but traces the
    derivatives even where nobody asks for any: 0.7 s.)
    """

    @jax.custom_jvp
    def root(system, held, p):
        if isinstance(solver, QuasiNewton):
            lanes = partial(evaluate_lanes, evaluate)
            p, known, history, steps, converged = minimize(
                lanes, system, held, p, Settings(solver.tolerance, solver.max_steps, solver.memory)
            )
            code = jnp.where(converged, 1, 2)
        else:
            p, known, history, steps, code = alternate(system, held, p, evaluate, solver)
        # As floats, because the tangents of integers are of a type of their own.
        return p, known, history, steps.astype(p.dtype), code.astype(p.dtype)

    @root.defjvp
    def root_jvp(primals, tangents):
        system, held, start = primals
        solution = root(system, held, start)
        p, known, *rest = solution

        def gradient(free, held):
            moved = jnp.where(system.free[None], free, held.targets)
            return evaluate(system, held, p=moved, known=known).gradient

        def keep(x):  # the unknowns are the free vertices; elsewhere the system is the identity
            return jnp.where(system.free[None], 0.0, x)

        def conjugate_gradients(matvec, b):
            tolerance = max(adjoint.tolerance, 20 * float(jnp.finfo(b.dtype).eps))
            precondition = lambda r: system.factor.solve(r) + keep(r)  # noqa: E731
            x, _ = jax.scipy.sparse.linalg.cg(
                matvec, b, tol=tolerance, maxiter=adjoint.max_steps, M=precondition
            )
            return x

        _, hessian = jax.linearize(lambda x: gradient(x, held), p)
        _, right = jax.jvp(lambda held: gradient(p, held), (held,), (tangents[1],))
        move = jax.lax.custom_linear_solve(
            lambda x: hessian(x) + keep(x), -right, conjugate_gradients, symmetric=True
        )
        move = jnp.where(system.free[None], move, tangents[1].targets)
        return solution, (move, *jax.tree.map(jnp.zeros_like, [known, *rest]))

    p, known, history, steps, code = root(system, held, jax.lax.stop_gradient(p))
    return p, known, history, steps.astype(jnp.int32), code.astype(jnp.int32)
