"""The thesis's iteration: local step, global step (Sec. 4.1.1)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxdeform._deformation.problem import System
from jaxdeform._deformation.reduced_energy import Held
from jaxdeform._linalg.lbfgs import has_converged


@dataclass(frozen=True)
class Alternating:
    """The thesis's iteration: local step, global step, a fixed number of times (Sec. 4.1.1).

    Each step lowers the energy (the normal term excepted); reaching the number is the normal end.
    """

    steps: int = 100
    """Number of iterations, or the most of them where a tolerance is given."""
    tolerance: float | None = None
    """Stop early once a step is expected to lower the energy by less than this part of it."""


def alternate(system: System, held: Held, p, evaluate, solver: Alternating):
    """The thesis's iteration as a scan, so that both modes of differentiation go through it."""

    @jax.checkpoint
    def step(p, last):
        # Kept for the backward pass: one p a step. All else is computed again there.
        state = evaluate(system, held, p=p)
        move = system.factor.solve(state.gradient)
        gain = jnp.sum(state.gradient * move)
        if solver.tolerance is None:
            done = last
        else:
            done = last | has_converged(gain, state.energy, state.rounding, solver.tolerance)
        # A^-1 K^T T, written as a correction of p: it heals its own rounding.
        p = jnp.where(done, p, p - move)
        return p, state.transforms, state.energy, done

    def body(carry, index):
        def go(p, known, energy, done, steps):
            del known, energy, done
            p, known, energy, done = step(p, index == solver.steps)
            return p, known, energy, done, steps + jnp.where(done, 0, 1)

        if solver.tolerance is None:
            carry = go(*carry)
        else:
            carry = jax.lax.cond(carry[3], lambda *c: c, go, *carry)
        return carry, carry[2]

    # One turn more than steps: it evaluates the end, so that the local step is compiled once.
    begin = (
        p,
        jnp.zeros((3, *p.shape), p.dtype),
        jnp.zeros((), p.dtype),
        jnp.asarray(False),
        jnp.asarray(0, jnp.int32),
    )
    turns = jnp.arange(solver.steps + 1, dtype=jnp.int32)
    (p, known, _, _, steps), history = jax.lax.scan(body, begin, turns)
    code = 0 if solver.tolerance is None else jnp.where(steps < solver.steps, 1, 2)
    return p, known, history, steps, jnp.asarray(code, jnp.int32)
