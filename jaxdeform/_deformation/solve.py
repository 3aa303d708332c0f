"""Deforming a mesh: the public function, its settings checked and its result."""

from functools import partial
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxdeform._deformation.adjoint import Implicit, Unrolled, solve_implicit
from jaxdeform._deformation.alternating import Alternating, alternate
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.problem import Problem, System
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.reduced_energy import Held, evaluate
from jaxdeform.checks import (
    as_array,
    check_positions,
    check_rigidity,
    check_targets,
    known,
    read_positions,
)
from jaxdeform.energy import local_energy
from jaxdeform.errors import InputError


class Result(eqx.Module):
    """How a deformation ended; ``str(result)`` is a sentence."""

    code: Int[Array, "..."]

    _sentences = (
        "Ran the number of steps that was asked for.",
        "Converged: a further step would lower the energy by less than the tolerance.",
        "Stopped at the step limit before the tolerance was reached: the shape is usable, but "
        "allow more steps (or loosen the tolerance) if you rely on derivatives.",
        "Not finite: the numbers overflowed. Check the scale of the mesh, the targets and the "
        "rigidity (its unit is length squared), or use float64.",
    )

    @property
    def ok(self) -> Bool[Array, "..."]:
        """True unless the step limit came first or the numbers overflowed."""
        return self.code < 2

    def __str__(self) -> str:
        """Return what happened, as a sentence (one per lane for a batch)."""
        if isinstance(self.code, Tracer):
            return "(known once the compiled function has run)"
        codes = np.unique(np.asarray(self.code))
        if len(codes) == 1:
            return self._sentences[int(codes[0])]
        count = [int(np.sum(np.asarray(self.code) == c)) for c in codes]
        return " ".join(
            f"{k} of {sum(count)}: {self._sentences[int(c)]}"
            for k, c in zip(count, codes, strict=True)
        )


class Solution(eqx.Module):
    """A deformed mesh and how it was reached."""

    vertices: Float[Array, "n 3"]
    """Deformed positions p'."""
    transforms: Float[Array, "n 3 3"]
    """T_k of every cell at these positions."""
    energy: Float[Array, "history"]
    """Reduced energy at the start and after each step; the last value repeats once it stopped."""
    steps: Int[Array, ""]
    """Iterations done."""
    result: Result
    """What happened, as a sentence."""


def deform(
    problem: Problem,
    targets: ArrayLike,
    rigidity: ArrayLike,
    *,
    local: LocalStep = Newton(),  # noqa: B008 (frozen)
    solver: Alternating | QuasiNewton | None = None,
    start: ArrayLike | None = None,
    handle_weights: ArrayLike | None = None,
    normals: bool = False,
    adjoint: Unrolled | Implicit | None = None,
) -> Solution:
    """Deform the mesh so that its handles reach their targets and the rest follows (Eq. 4.4).

    A pure function of arrays: works under jit, vmap (over targets, rigidity, start), grad and jvp
    (to rigidity and targets).

    **Arguments**

    - problem: from :func:`precompute`.
    - targets: (h, 3) positions of the handles, in the order of ``problem.handles``.
    - rigidity: lambda >= 0, a number or one per vertex (n,). Its unit is length squared: small is
      rubber, large is steel; :func:`material` makes it from a scale-free constant.
    - local: solver of the local step: ``Newton()`` (default), ``LBFGS()``, ``GradientDescent()``;
      ``RotationFit()`` makes it ARAP, ``AffineFit()`` drops the resistance to strain.
    - solver: ``QuasiNewton()`` (default: to convergence) or ``Alternating(steps=100)`` (as in the
      thesis; the default with normals).
    - start: (n, 3) first guess; Laplacian editing (Sec. 4.1.2) if left out.
    - handle_weights: other weights of the soft handles than in :func:`precompute`, one or (h,),
      0 or more and at most those (the factor stays, and bounds the energy from above then);
      entries of hard handles are not read. Differentiable.
    - normals: add the normal term of Eq. 4.7, which holds flat neighbourhoods.
    - adjoint: how derivatives are made: ``Unrolled()`` (default of Alternating) or ``Implicit()``
      (the only one of QuasiNewton).

    **Returns** a :class:`Solution`.

    **Raises** InputError: targets or start of the wrong shape or not finite; rigidity negative,
    not finite or of the wrong length; settings that exclude each other. Values are checked when
    they are known, shapes also while tracing.

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
    if solver is None:
        solver = Alternating() if normals else QuasiNewton()
    if adjoint is None:
        adjoint = Unrolled() if isinstance(solver, Alternating) else Implicit()
    _check_settings(solver, adjoint, normals)
    n, dtype = problem.n_vertices, problem.dtype
    targets = check_targets(targets, len(problem.handles), dtype)
    rigidity = check_rigidity(rigidity, n, dtype)
    if start is not None:
        start = read_positions("start", start, (n, 3), dtype)
    given = _spread(problem, targets), rigidity, _soft(problem, handle_weights)
    held = Held(*(cast(Array, x) for x in given))  # JAX's arrays once they are inside
    solution = _solve(problem.system, held, start, local, solver, normals, adjoint)
    if not isinstance(solution.vertices, Tracer):
        # The host's factor lives as long as the problem; do not outrun it.
        jax.block_until_ready(solution)
    return solution


def energy(
    problem: Problem, vertices: ArrayLike, transforms: ArrayLike, rigidity: ArrayLike
) -> Float[Array, ""]:
    """Return Eq. 4.4 at any positions and transformations (the pull of soft handles not included).

    **Arguments**: problem; vertices (n, 3); transforms (n, 3, 3); rigidity, a number or (n,).
    **Raises** InputError for wrong shapes.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> mesh = jd.shapes.bar()
        >>> problem = jd.precompute(mesh, [0])
        >>> rest = np.broadcast_to(np.eye(3), (722, 3, 3))
        >>> bool(abs(jd.energy(problem, mesh.vertices, rest, 1.0)) < 1e-2)
        True
    """
    n, dtype, system = problem.n_vertices, problem.dtype, problem.system
    p = check_positions("vertices", vertices, (n, 3), dtype).T - system.center[:, None]
    t = check_positions("transforms", transforms, (n, 3, 3), dtype)
    lam = jnp.asarray(check_rigidity(rigidity, n, dtype))
    t = jnp.einsum("kai,ijk->ajk", t, system.frames, precision="highest")
    stiff = system.stiffness.apply(p) - system.soft[None] * p
    return jnp.sum(p * stiff) + local_energy(t, system.scatter(p), system.b, lam)


def _check_settings(solver, adjoint, normals: bool) -> None:
    steps = solver.steps if isinstance(solver, Alternating) else solver.max_steps
    if steps < 1:
        raise InputError(f"{type(solver).__name__} was given {steps} steps: give 1 or more")
    if isinstance(solver, QuasiNewton) and isinstance(adjoint, Unrolled):
        raise InputError(
            "Unrolled() differentiates the thesis's iterations: use it with solver=Alternating(), "
            "or Implicit() with QuasiNewton()"
        )
    if normals and (isinstance(solver, QuasiNewton) or isinstance(adjoint, Implicit)):
        raise InputError(
            "with normals the iteration is not the descent of one energy (n' lags behind): use "
            "solver=Alternating() and adjoint=Unrolled()"
        )


def _spread(
    problem: Problem, targets: Array | np.ndarray
) -> Float[Array, "3 n"] | Float[np.ndarray, "3 n"]:
    """Spread the targets over an array of all vertices, in NumPy where they are known.

    So the compiled code sees shapes that depend on the mesh alone: another number of handles does
    not compile anything anew.
    """
    if known(targets) and known(problem.system.center):
        spread = np.array(problem.system.rest)
        center = np.asarray(problem.system.center)
        spread[:, problem.handles] = (np.asarray(targets) - center).T
        return spread
    moved = (targets - problem.system.center[None]).T
    return problem.system.rest.at[:, problem.handles].set(moved)


def _soft(problem: Problem, weights: ArrayLike | None) -> Float[Array, "n"]:
    """Spread the weights of soft handles over all vertices, 0 at hard ones and elsewhere."""
    system = problem.system
    if weights is None:
        return system.soft
    given = as_array(weights, problem.dtype, "handle_weights")
    if given.shape not in ((), problem.handles.shape):
        raise InputError(
            f"handle_weights have shape {given.shape}: give one number or one per handle, "
            f"{problem.handles.shape}"
        )
    given = jnp.broadcast_to(given, problem.handles.shape)
    given = jnp.where(system.free[problem.handles], given, 0.0)
    if known(given) and known(system.soft):
        most = np.asarray(system.soft)[problem.handles]
        bad = np.flatnonzero(~((np.asarray(given) >= 0) & (np.asarray(given) <= most)))
        if bad.size:
            raise InputError(
                f"the weight of handle {problem.handles[bad[0]]} is {given[bad[0]]}: give 0 to "
                f"{most[bad[0]]}, the weight that it had in precompute"
            )
    return jnp.zeros_like(system.soft).at[problem.handles].set(given)


@partial(jax.jit, static_argnames=("local", "solver", "normals", "adjoint"))
def _solve(system, held, start, local, solver, normals, adjoint) -> Solution:
    if start is None:
        # Soft handles lead the first guess like hard ones.
        led = ~system.free | (system.soft > 0)
        motion = jnp.where(led[None], held.targets - system.rest, 0.0)
        p = system.rest + system.start(motion)
    else:
        p = start.T - system.center[:, None]
    p = jnp.where(system.free[None], p, held.targets)
    at = partial(evaluate, local=local, normals=normals)
    if isinstance(adjoint, Implicit):
        p, known, history, steps, code = solve_implicit(system, held, p, at, solver, adjoint)
    else:
        p, known, history, steps, code = alternate(system, held, p, at, solver)
    known, energy = _attach_end(at, system, held, p, known, history[steps])
    history = jnp.where(jnp.arange(history.shape[0], dtype=steps.dtype) >= steps, energy, history)
    finite = jnp.isfinite(energy) & jnp.all(jnp.isfinite(p))
    world = jnp.einsum("aik,jik->kaj", known, system.frames, precision="highest")
    return Solution(
        vertices=(p + system.center[:, None]).T,
        transforms=world,
        energy=history,
        steps=steps,
        result=Result(jnp.where(finite, code, 3)),
    )


def _attach_end(evaluate, system: System, held: Held, p, known, energy):
    """Return the transformations and the energy at p with their derivatives.

    Both are known, so nothing is evaluated (nor compiled) unless derivatives are asked for.
    """

    @jax.custom_jvp
    def end(system, held, p, known, energy):
        del system, held, p
        return known, energy

    @end.defjvp
    def end_jvp(primals, tangents):
        system, held, p, *reached = primals

        def run(held, p):
            at = evaluate(system, held, p=p, known=reached[0])
            return at.transforms, at.energy

        return tuple(reached), jax.jvp(run, (held, p), tuple(tangents[1:3]))[1]

    return end(system, held, p, known, energy)
