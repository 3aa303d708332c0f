"""Deforming a mesh: the public function, and the solution that it returns."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._arrays import is_concrete
from jaxdeform._checks import check_flag
from jaxdeform._deformation.arguments import (
    DeformSettings,
    from_center,
    read_geometry,
    read_inputs,
    read_settings,
    read_vertices,
)
from jaxdeform._deformation.cell_energy import cell_energies
from jaxdeform._deformation.descent import Adjoint, Anchor, Descent, Solver
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.outcome import inside_out, outcome_of
from jaxdeform._deformation.problem import Problem, check_problem
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.system import System
from jaxdeform._errors import ArrayLike, InputError, first_few
from jaxdeform._linalg.buckets import cut, fill_up
from jaxdeform._linalg.known_value import with_derivative_of
from jaxdeform._linalg.varying import as_varying
from jaxdeform._linalg.waiting import wait_for
from jaxdeform._linalg.xla import AS_FAST, quick_jit
from jaxdeform._result import Result, check_result, succeeded
from jaxdeform._values import read_positions, read_rigidity


class Solution(eqx.Module):
    """A deformed mesh and how it was reached.

    **Fields**

    - vertices: (*batch, vertices, 3) deformed positions p'.
    - transforms: (*batch, vertices, 3, 3) T_k of every cell at these positions.
    - energy: (*batch, history) reduced energy at the start and after each step; the last value
      repeats once it stopped.
    - steps: (*batch,) iterations done.
    - result: what happened, a member of `Result`.
    - flipped: (*batch,) number of cells that are inside out (det T <= 0): a part of the mesh is its
      mirror image.
    - jumped: (*batch,) of a frame of `deform_path`: the shape jumped to another equilibrium.
    """

    vertices: Float[Array, "*batch vertices 3"]
    transforms: Float[Array, "*batch vertices 3 3"]
    energy: Float[Array, "*batch history"]
    steps: Int[Array, "*batch"]
    result: Result
    flipped: Int[Array, "*batch"]
    jumped: Bool[Array, "*batch"]

    @property
    def ok(self) -> Bool[Array, "*batch"]:
        """True if it converged, or ran the number of steps that was asked for."""
        return succeeded(self.result)

    def explain(self) -> str:
        """Return what happened in words, and name the first cells that are not as they should be.

        Of one solution, once the values are known. Of a batch it raises InputError.
        """
        batch = self.transforms.shape[:-3]
        if batch:
            raise InputError(
                f"explain is of one solution, and these are a batch of shape {batch}: take one "
                "member, as in jax.tree.map(lambda x: x[0], out).explain()"
            )
        t = np.asarray(self.transforms)
        finite = np.isfinite(t).all(axis=(1, 2))
        orientation = np.einsum("ki,ki->k", t[:, 0], np.cross(t[:, 1], t[:, 2]))
        # Of a deformation that was not done the cells say nothing.
        flipped = finite & (orientation <= 0) & (self.result != Result.bad_input)
        text = Result[self.result]
        for what, bad in (("at fault", ~finite), ("inside out (det T <= 0)", flipped)):
            at = np.flatnonzero(bad)
            text += f" Cells {what}: {first_few(at)} ({len(at)} of {len(t)})." if at.size else ""
        return text + (" The shape jumped to another equilibrium." if self.jumped else "")


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
    rest: ArrayLike | None = None,
    edge_weights: ArrayLike | None = None,
    throw: bool = False,
) -> Solution:
    """Deform the mesh so that its handles reach their targets and the rest follows (Eq. 4.4).

    A pure function of arrays: it works under jit, vmap (over targets, rigidity, start), grad, jvp
    and hessian (to targets, rigidity, handle_weights, and to rest and edge_weights). What has no
    derivative, such as the arrays of the problem, raises instead of giving 0.

    **Arguments**

    - problem: from `precompute`.
    - targets: (handles, 3) positions of the handles, in the order of ``problem.handles``.
    - rigidity: lambda >= 0, a number or one per vertex (vertices,). Its unit is length squared:
      small is rubber, large is steel. `rigidity_from_material` makes it from a scale-free
      constant.
    - local: solver of the local step. ``Newton()`` is the default; ``LBFGS()`` and
      ``GradientDescent()`` find the same minimum. ``RotationFit()`` makes it ARAP, ``AffineFit()``
      drops the resistance to strain. Any `LocalStep` will do.
    - solver: ``QuasiNewton()`` (default: to convergence) or ``Alternating(steps=100)`` (as in the
      thesis; the default with normals).
    - start: (vertices, 3) first guess; by default Laplacian editing (Sec. 4.1.2). It decides which
      minimum is found; `deform_path` follows the handles to another one.
    - handle_weights: other weights of the soft handles than in `precompute`, one or
      (handles,), from 0 to those of `precompute` (whose factor stays, and bounds the energy
      from above). Entries of hard handles are not read. Differentiable.
    - normals: add the normal term of Eq. 4.7, which holds flat neighbourhoods. Faces need not agree
      about the side, and on a Moebius band they cannot: around each vertex one side is chosen.
    - adjoint: how derivatives are made: ``Unrolled()`` (default of Alternating) or ``Implicit()``
      (the only one of QuasiNewton).
    - rest: (vertices, 3), the problem's own rest positions, given for derivatives with respect to
      them: the derivative is that of ``precompute`` and ``deform`` together. With ``Implicit()``
      only. First and second derivatives; third ones raise InputError.
    - edge_weights: (edges,), the problem's own edge weights, likewise. Without them the derivative
      to ``rest`` includes that of the cotangent weights.
    - throw: raise an error if the result is not ``ok``, also inside jit. By default numerical
      trouble comes back in ``result``, because one bad member of a batch must not end the others.

    **Returns** a `Solution`. Numerical trouble comes back in its ``result``.

    **Raises** InputError: targets or start of the wrong shape or not finite; rigidity negative,
    not finite or of the wrong length; settings that exclude each other. Shapes are checked always,
    values where they are known. While JAX traces they are not: then ``result`` is ``bad_input``.

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
    check_flag("throw", throw)
    settings = read_settings(problem.dtype, local, solver, adjoint, normals)
    rows = len(problem.handles)
    relative = from_center(problem, "targets", targets, (rows, 3), "handle")
    inputs = read_inputs(problem, relative, rigidity, handle_weights)
    if start is not None:
        start = read_vertices(problem, "start", start)
    if rest is not None or edge_weights is not None:
        inputs = inputs._replace(geometry=read_geometry(problem, rest, edge_weights))
        if not settings.adjoint.needs_one_energy:
            raise InputError(
                "rest and edge_weights are differentiated by Implicit() only: give "
                "adjoint=jd.Implicit()"
            )
    if start is None:
        start = guess_at_once(problem.system, inputs.targets)
    numbers, settings = settings.apart(problem.dtype)
    out = _solve_at_once(problem.system, inputs, start, numbers, settings)
    out = cut_to_mesh(out, problem.n_vertices)
    return check_result(out, throw)


def cut_to_mesh(out: Solution, count: int) -> Solution:
    """Leave out what fills up the arrays of a solution, and wait for it where Ctrl-C is heard."""
    out = wait_for(out)
    vertices, transforms = cut(out.vertices, count, -2), cut(out.transforms, count, -3)
    return dataclasses.replace(out, vertices=vertices, transforms=transforms)


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
    system = problem.system
    p = jnp.asarray(read_vertices(problem, "vertices", vertices))
    shape = problem.n_vertices, 3, 3
    t = read_positions("transforms", transforms, shape, problem.dtype)
    t = np.asarray(t) if is_concrete(t) else t
    t = fill_up(t.transpose(1, 2, 0), problem.bucket)
    # Without rigidity, so that T = 0 of what fills up costs nothing.
    lam = fill_up(read_rigidity(rigidity, problem.n_vertices, problem.dtype), problem.bucket)
    return _energy(system, p, jnp.asarray(t), jnp.asarray(lam))


@jax.jit
def _energy(
    system: System,
    p: Float[Array, "3 vertices"],
    t: Float[Array, "3 3 vertices"],
    lam: Float[Array, "vertices"],
) -> Float[Array, ""]:
    t = system.into_axes(t)
    stiff = system.stiffness.apply(p) - system.soft[None] * p
    cells = cell_energies(t, system.covariance(p), system.principal_moments, lam)
    return jnp.sum(p * stiff) + jnp.sum(cells)


def solve(
    system: System,
    inputs: Inputs,
    start: Float[Array, "3 vertices"] | Float[np.ndarray, "3 vertices"] | None,
    settings: DeformSettings,
) -> Solution:
    """Deform once; without a start, from Laplacian editing."""
    system = without_derivative(system)
    if start is None:
        start = first_guess(system, inputs.targets)
    return descend(system, inputs, jnp.asarray(start), settings)[0]


@quick_jit(static=("settings",), options=AS_FAST)
def _solve_at_once(system, inputs, start, numbers, settings):
    return solve(system, inputs, start, settings.together(numbers))


def first_guess(system: System, targets: Float[Array, "3 vertices"]) -> Float[Array, "3 vertices"]:
    """Return where Laplacian editing puts the vertices."""
    return system.rest + guess(system, targets - system.rest)


@quick_jit(static=())
def guess_at_once(
    system: System, targets: Float[Array, "3 vertices"]
) -> Float[Array, "3 vertices"]:
    """Return the first guess by a program of its own: a start given later compiles nothing anew."""
    return first_guess(without_derivative(system), targets)


def guess(system: System, displacement: Float[Array, "3 vertices"]) -> Float[Array, "3 vertices"]:
    """Return the displacement of all vertices that Laplacian editing makes of that of handles.

    Soft handles lead like hard ones.
    """
    return system.initial_guess(jnp.where(system.led[None], displacement, 0.0))


def descend(
    system: System, inputs: Inputs, start: Float[Array, "3 vertices"], settings: DeformSettings
) -> tuple[Solution, Float[Array, "3 vertices"]]:
    """Minimise from a start, whose hard handles need not be on their targets.

    Return the solution, and its positions relative to the centre of the rest shape.
    """
    energy, solver, adjoint = settings
    system, inputs, start = as_varying((system, inputs, start))
    start = jnp.where(system.free[None], start, inputs.targets)
    end, anchor = adjoint.solve(solver, energy, system, inputs, start)
    p = end.positions
    transforms, value = _with_derivatives_at_end(
        energy, system, inputs, anchor, end.transforms, end.energy[end.steps]
    )
    return solution_of(system, inputs, end._replace(transforms=transforms), value), p


def solution_of(system: System, inputs: Inputs, end: Descent, value: Float[Array, ""]) -> Solution:
    """Return what a user gets of a descent, whose last energy is ``value``."""
    after = jnp.arange(end.energy.shape[0], dtype=end.steps.dtype) >= end.steps
    return Solution(
        vertices=(end.positions + system.center[:, None]).T,
        transforms=jnp.moveaxis(system.out_of_axes(end.transforms), -1, 0),
        energy=jnp.where(after, value, end.energy),
        steps=end.steps,
        result=outcome_of(*jax.lax.stop_gradient((system, inputs, end))),
        flipped=inside_out(jax.lax.stop_gradient(end.transforms)),
        jumped=as_varying(jnp.zeros((), bool), end.steps),
    )


@jax.custom_jvp
def without_derivative(system: System) -> System:
    """Return the system, which refuses derivatives with respect to it."""
    return system


@partial(without_derivative.defjvp, symbolic_zeros=True)
def without_derivative_jvp(primals, tangents):
    if not all(isinstance(t, SymbolicZero) for t in jax.tree.leaves(tangents)):
        raise InputError(
            "the arrays of a Problem have no derivative here: differentiate in rest= and "
            "edge_weights= of deform, in targets, rigidity or handle_weights"
        )
    return primals[0], tangents[0]


def _with_derivatives_at_end(
    energy: ReducedEnergy, system: System, inputs: Inputs, anchor: Anchor, transforms, value
):
    """Return the transformations and the energy of the end with the derivatives at the anchor.

    Both are known, so nothing is evaluated (nor compiled) unless derivatives are asked for.
    """

    @jax.custom_jvp
    def at_end(system, inputs, anchor, transforms, value):
        del system, inputs, anchor
        return transforms, value

    @at_end.defjvp
    def at_end_jvp(primals, tangents):
        system, inputs, anchor, *_ = primals

        def run(inputs, p):
            at = energy.evaluate(system, inputs, p, anchor.transforms)
            return at.transforms, at.energy

        at = inputs, anchor.positions
        known = with_derivative_of(run, primals[3:], *at)  # so that this rule has derivatives too
        return known, jax.jvp(run, at, (tangents[1], tangents[2].positions))[1]

    return at_end(system, inputs, anchor, transforms, value)
