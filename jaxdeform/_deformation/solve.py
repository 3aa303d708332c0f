"""Deforming a mesh: the public function, and the solution that it returns."""

from functools import partial
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._arrays import as_array, is_concrete
from jaxdeform._checks import (
    check_flag,
    check_positions,
    check_rigidity,
    check_targets,
    read_positions,
)
from jaxdeform._deformation.alternating import Alternating
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.energy import local_energy
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.local_step_check import check_local_step
from jaxdeform._deformation.problem import Problem, System, check_problem
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._result import Result, succeeded


class Solution(eqx.Module):
    """A deformed mesh and how it was reached."""

    vertices: Float[Array, "*batch vertices 3"]
    """Deformed positions p'."""
    transforms: Float[Array, "*batch vertices 3 3"]
    """T_k of every cell at these positions."""
    energy: Float[Array, "*batch history"]
    """Reduced energy at the start and after each step; the last value repeats once it stopped."""
    steps: Int[Array, "*batch"]
    """Iterations done."""
    result: Result
    """What happened: a member of :class:`Result`."""

    @property
    def ok(self) -> Bool[Array, "*batch"]:
        """True if it converged, or ran the number of steps that was asked for."""
        return succeeded(self.result)

    def explain(self) -> str:
        """Return what happened in words, with the first cells that have no finite transformation.

        Of one solution, not of a batch, and once the values are known.
        """
        bad = np.flatnonzero(~np.isfinite(np.asarray(self.transforms)).all(axis=(1, 2)))
        shown = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        where = f" Cells at fault: {shown} ({len(bad)} of {len(self.transforms)})."
        return Result[self.result] + (where if bad.size else "")


def deform(
    problem: Problem,
    targets: ArrayLike,
    rigidity: ArrayLike,
    *,
    local: LocalStep = Newton(),  # noqa: B008 (frozen)
    solver: Solver | None = None,
    start: ArrayLike | None = None,
    handle_weights: ArrayLike | None = None,
    normals: bool = False,
    adjoint: Adjoint | None = None,
) -> Solution:
    """Deform the mesh so that its handles reach their targets and the rest follows (Eq. 4.4).

    A pure function of arrays: it works under jit, vmap (over targets, rigidity, start), grad, jvp
    and, with the implicit derivative, hessian (to targets, rigidity and handle_weights).

    **Arguments**

    - problem: from :func:`precompute`.
    - targets: (handles, 3) positions of the handles, in the order of ``problem.handles``.
    - rigidity: lambda >= 0, a number or one per vertex (vertices,). Its unit is length squared:
      small is rubber, large is steel. :func:`rigidity_from_material` makes it from a scale-free
      constant.
    - local: solver of the local step. ``Newton()`` is the default; ``LBFGS()`` and
      ``GradientDescent()`` find the same minimum. ``RotationFit()`` makes it ARAP, ``AffineFit()``
      drops the resistance to strain. Any :class:`LocalStep` will do.
    - solver: ``QuasiNewton()`` (default: to convergence) or ``Alternating(steps=100)`` (as in the
      thesis; the default with normals).
    - start: (vertices, 3) first guess; by default Laplacian editing (Sec. 4.1.2).
    - handle_weights: other weights of the soft handles than in :func:`precompute`, one or
      (handles,), from 0 to those of :func:`precompute` (whose factor stays, and bounds the energy
      from above). Entries of hard handles are not read. Differentiable.
    - normals: add the normal term of Eq. 4.7, which holds flat neighbourhoods.
    - adjoint: how derivatives are made: ``Unrolled()`` (default of Alternating) or ``Implicit()``
      (the only one of QuasiNewton).

    **Returns** a :class:`Solution`. Numerical trouble comes back in its ``result``.

    **Raises** InputError: targets or start of the wrong shape or not finite; rigidity negative,
    not finite or of the wrong length; settings that exclude each other. Shapes are checked always,
    values where they are known (they are not while JAX traces).

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> y = mesh.vertices[:, 1]
        >>> handles = ((y < 6) | (y > 145)).nonzero()[0]
        >>> problem = jd.precompute(mesh, handles)
        >>> out = jd.deform(problem, jd.bend(mesh.vertices[handles], 90.0), rigidity=1.0)
        >>> out.vertices.shape
        (722, 3)
    """
    check_problem(problem)
    check_flag("normals", normals)
    if solver is None:
        solver = Alternating() if normals else QuasiNewton()
    adjoint = choose_adjoint(solver, adjoint)
    if normals and (solver.needs_one_energy or adjoint.needs_one_energy):
        raise InputError(
            "with normals the iteration is not the descent of one energy (n' lags behind): use "
            "solver=Alternating() and adjoint=Unrolled()"
        )
    check_local_step(local)
    count, dtype = problem.n_vertices, problem.dtype
    targets = check_targets(targets, len(problem.handles), dtype)
    rigidity = check_rigidity(rigidity, count, dtype)
    if start is not None:
        start = read_positions("start", start, (count, 3), dtype)
    spread = _spread_targets(problem, targets), rigidity, _spread_weights(problem, handle_weights)
    inputs = Inputs(*(cast(Array, x) for x in spread))  # JAX's arrays once they are inside
    return _solve(problem.system, inputs, start, ReducedEnergy(local, normals), solver, adjoint)


def energy(
    problem: Problem, vertices: ArrayLike, transforms: ArrayLike, rigidity: ArrayLike
) -> Float[Array, ""]:
    """Return Eq. 4.4 at any positions and transformations (without the pull of soft handles).

    **Arguments**: problem; vertices (vertices, 3); transforms (vertices, 3, 3); rigidity, a number
    or (vertices,). **Raises** InputError for wrong shapes.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> mesh = jd.shapes.bar()
        >>> problem = jd.precompute(mesh, [0])
        >>> rest = np.broadcast_to(np.eye(3), (722, 3, 3))
        >>> bool(abs(jd.energy(problem, mesh.vertices, rest, 1.0)) < 1e-2)
        True
    """
    check_problem(problem)
    count, dtype, system = problem.n_vertices, problem.dtype, problem.system
    p = check_positions("vertices", vertices, (count, 3), dtype).T - system.center[:, None]
    t = check_positions("transforms", transforms, (count, 3, 3), dtype)
    lam = jnp.asarray(check_rigidity(rigidity, count, dtype))
    t = jnp.einsum("kai,ijk->ajk", t, system.principal_axes, precision="highest")
    stiff = system.stiffness.apply(p) - system.soft[None] * p
    cells = local_energy(t, system.covariance(p), system.principal_moments, lam)
    return jnp.sum(p * stiff) + cells


def _spread_targets(
    problem: Problem, targets: Array | np.ndarray
) -> Float[Array, "3 vertices"] | Float[np.ndarray, "3 vertices"]:
    """Spread the targets over an array of all vertices, in NumPy where they are known.

    So the compiled code sees shapes that depend on the mesh alone: another number of handles does
    not compile anything anew.
    """
    system, handles = problem.system, problem.handles
    if all(map(is_concrete, (targets, system.center, system.rest, handles))):
        spread = np.array(system.rest)
        spread[:, np.asarray(handles)] = (np.asarray(targets) - np.asarray(system.center)).T
        return spread
    return system.rest.at[:, handles].set((targets - system.center[None]).T)


def _spread_weights(problem: Problem, weights: ArrayLike | None) -> Float[Array, "vertices"]:
    """Spread the weights of soft handles over all vertices, 0 at hard ones and elsewhere."""
    system, handles = problem.system, problem.handles
    if weights is None:
        return system.soft
    given = as_array(weights, problem.dtype, "handle_weights")
    if given.shape not in ((), handles.shape):
        raise InputError(
            f"handle_weights have shape {given.shape}: give one number or one per handle, "
            f"{handles.shape}"
        )
    given = jnp.broadcast_to(given, handles.shape)
    given = jnp.where(system.free[handles], given, 0.0)
    if is_concrete(given) and is_concrete(system.soft):
        most = np.asarray(system.soft)[np.asarray(handles)]
        bad = np.flatnonzero(~((np.asarray(given) >= 0) & (np.asarray(given) <= most)))
        if bad.size:
            raise InputError(
                f"the weight of handle {handles[bad[0]]} is {given[bad[0]]}: give 0 to "
                f"{most[bad[0]]}, the weight that it had in precompute"
            )
    return jnp.zeros_like(system.soft).at[handles].set(given)


@partial(jax.jit, static_argnames=("energy", "solver", "adjoint"))
def _solve(
    system: System,
    inputs: Inputs,
    start: Float[Array, "vertices 3"] | Float[np.ndarray, "vertices 3"] | None,
    energy: ReducedEnergy,
    solver: Solver,
    adjoint: Adjoint,
) -> Solution:
    p = _first_positions(system, inputs, start)
    end = adjoint.solve(solver, energy, system, inputs, p)
    p, steps = end.positions, end.steps
    transforms, value = _with_derivatives_at_end(
        energy, system, inputs, p, end.transforms, end.energy[steps]
    )
    after = jnp.arange(end.energy.shape[0], dtype=steps.dtype) >= steps
    finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(p))
    return Solution(
        vertices=(p + system.center[:, None]).T,
        transforms=jnp.einsum(
            "aik,jik->kaj", transforms, system.principal_axes, precision="highest"
        ),
        energy=jnp.where(after, value, end.energy),
        steps=steps,
        result=Result.where(finite, end.result, Result.not_finite),
    )


def _first_positions(system: System, inputs: Inputs, start) -> Float[Array, "3 vertices"]:
    if start is None:
        # Soft handles lead the first guess like hard ones.
        led = ~system.free | (system.soft > 0)
        displacement = jnp.where(led[None], inputs.targets - system.rest, 0.0)
        p = system.rest + system.initial_guess(displacement)
    else:
        p = start.T - system.center[:, None]
    return jnp.where(system.free[None], p, inputs.targets)


def _with_derivatives_at_end(energy: ReducedEnergy, system, inputs, p, transforms, value):
    """Return the transformations and the energy at p with their derivatives.

    Both are known, so nothing is evaluated (nor compiled) unless derivatives are asked for.
    """

    @jax.custom_jvp
    def at_end(system, inputs, p, transforms, value):
        del system, inputs, p
        return transforms, value

    @at_end.defjvp
    def at_end_jvp(primals, tangents):
        system, inputs, p, transforms, _ = primals

        def run(inputs, p):
            at = energy.evaluate(system, inputs, p, transforms)
            return at.transforms, at.energy

        known = at_end(*primals)  # so that this rule has derivatives too
        return known, jax.jvp(run, (inputs, p), tuple(tangents[1:3]))[1]

    return at_end(system, inputs, p, transforms, value)
