"""Deforming a mesh: precompute once, then deform as often as you like (thesis Sec. 4.1)."""

import warnings
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxdeform.energy import Rows, Scatter, by_lane, local_energy, scatter, stiffness, total
from jaxdeform.global_step import Anchor, Factor, NotPositiveDefinite, factorise
from jaxdeform.handles import (
    as_array,
    check_components,
    check_handle_weights,
    check_handles,
    check_positions,
    check_targets,
    known,
    read_array,
    read_positions,
)
from jaxdeform.laplacian_editing import LaplacianStart, laplacian_start
from jaxdeform.local_step import LocalStep, Newton, fit
from jaxdeform.mesh import InputError, Mesh
from jaxdeform.neighborhood import Cells, moments, rings
from jaxdeform.quasi_newton import QuasiNewton, Sample, has_converged, minimize

# ---------------------------------------------------------------- what the caller chooses


@dataclass(frozen=True)
class Alternating:
    """The thesis's iteration: local step, global step, a fixed number of times (Sec. 4.1.1).

    Each step lowers the energy (the normal term excepted); reaching the number is the normal end.
    """

    steps: int = 100
    """Number of iterations, or the most of them where a tolerance is given."""
    tolerance: float | None = None
    """Stop early once a step is expected to lower the energy by less than this part of it."""


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


# ---------------------------------------------------------------- what passes between the floors


class System(eqx.Module):
    """Everything of a problem that the iterations read, vertex axis last, all shapes by n alone."""

    rest: Float[Array, "3 n"]
    """Rest positions, moved so that their centre is the origin."""
    center: Float[Array, "3"]
    free: Bool[Array, "n"]
    soft: Float[Array, "n"]
    """Weight of the pull of each soft handle, 0 elsewhere."""
    b: Float[Array, "3 n"]
    frames: Float[Array, "3 3 n"]
    scatter: Scatter
    stiffness: Rows
    factor: Factor
    start: LaplacianStart
    faces: Int[Array, "m 3"]


class Problem(eqx.Module):
    """A mesh with its cells and handles, factored. Made by :func:`precompute`."""

    system: System
    handles: Int[np.ndarray, "h"]
    """Indices of the handle vertices, in the order of the targets' rows."""
    anchor: Anchor = eqx.field(static=True, repr=False)

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return self.system.rest.shape[1]

    @property
    def vertices(self) -> Float[Array, "n 3"]:
        """Rest positions."""
        return (self.system.rest + self.system.center[:, None]).T

    @property
    def dtype(self) -> np.dtype:
        """Type of all numbers: float64 where JAX is set to it, else float32."""
        return np.dtype(self.system.rest.dtype)

    def __repr__(self) -> str:
        """Return the sizes, not the arrays."""
        return f"Problem({self.n_vertices} vertices, {len(self.handles)} handles, {self.dtype})"


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


class _Held(NamedTuple):
    """The inputs that may have derivatives."""

    targets: Float[Array, "3 n"]
    """Target positions at handles, hard and soft; rest positions elsewhere."""
    rigidity: Float[Array, "n"]
    soft: Float[Array, "n"]
    """Weights of the soft handles; those of the system, which its factor holds, if not given."""


# ---------------------------------------------------------------- precompute


def precompute(
    mesh: Mesh,
    handles: ArrayLike,
    *,
    cells: Cells | None = None,
    handle_weights: ArrayLike = np.inf,
    dtype: np.dtype | type | None = None,
) -> Problem:
    """Factor the global step of a mesh and a set of handles, once for every later deformation.

    One factorisation serves every rigidity, every target, every batch lane and every gradient,
    because A depends on the rest mesh, the cells and the handle set only (Eq. 4.5).

    **Arguments**

    - mesh: the rest shape.
    - handles: (h,) vertex indices, each once.
    - cells: ``rings(mesh, r)`` or ``spokes(mesh)``; ``rings(mesh, 1)`` if left out.
    - handle_weights: a number or (h,). Infinite (the default): the handle sits on its target. A
      finite weight w >= 0 pulls with ``w |p' - target|^2`` instead; its unit is that of the edge
      weights (none).
    - dtype: float32 or float64; by default float64 where ``jax_enable_x64`` is set.

    **Raises** InputError: no handles; an index out of range or repeated; a connected part of the
    mesh without any handle (it could lie anywhere); cells of another mesh.

    Unreferenced vertices stay where they are. Where negative cotangent weights make A indefinite,
    they are lifted to 1e-3 of the mean weight, with a warning.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> y = mesh.vertices[:, 1]
        >>> handles = ((y < 6) | (y > 145)).nonzero()[0]
        >>> problem = jd.precompute(mesh, handles)
    """
    n = mesh.n_vertices
    index = check_handles(handles, n)
    cells = rings(mesh, 1) if cells is None else cells
    if cells.n_vertices != n or len(cells.edges) != len(mesh.edges):
        raise InputError(
            f"cells are of another mesh ({cells.n_vertices} vertices, {len(cells.edges)} edges; "
            f"this one has {n} and {len(mesh.edges)}): call rings(mesh, r) on this mesh"
        )
    pull = check_handle_weights(handle_weights, index)
    referenced = np.zeros(n, bool)
    referenced[mesh.faces.ravel()] = True
    check_components(mesh, index[pull > 0], referenced)

    kind = np.dtype(dtype if dtype is not None else jnp.result_type(float))
    if kind not in (np.float32, np.float64):
        raise InputError(f"dtype {kind} is not supported: use float32 or float64")
    if kind == np.float64 and not jax.config.read("jax_enable_x64"):
        raise InputError(
            'dtype float64 needs jax.config.update("jax_enable_x64", True) before anything else'
        )
    free = referenced.copy()
    free[index[np.isinf(pull)]] = False
    soft = np.zeros(n)
    finite = np.isfinite(pull)
    soft[index[finite]] = pull[finite]

    center = mesh.vertices[referenced].mean(axis=0)
    rest = mesh.vertices - center
    cells, matrix, factor, held = _factorise(cells, rest, free, soft, kind)
    b, frames = moments(cells.edges, cells.weights, cells.membership, rest)
    start, start_held = laplacian_start(cells, free & (soft == 0), kind)
    system = System(
        rest=jnp.asarray(rest.T, kind),
        center=jnp.asarray(center, kind),
        free=jnp.asarray(free),
        soft=jnp.asarray(soft, kind),
        b=jnp.asarray(b.T, kind),
        frames=jnp.asarray(frames.transpose(1, 2, 0), kind),
        scatter=scatter(cells, rest, frames, kind),
        stiffness=Rows.build([sp.csr_matrix(matrix)], kind),
        factor=factor,
        start=start,
        faces=jnp.asarray(mesh.faces, jnp.int32),
    )
    return Problem(system, index, Anchor(held, start_held))


def _factorise(cells: Cells, rest, free: np.ndarray, soft: np.ndarray, dtype: np.dtype):
    matrix = stiffness(cells) + sp.diags(soft)
    try:
        return cells, matrix, *factorise(matrix, free, dtype, positions=rest)
    except NotPositiveDefinite:
        pass
    floor = 1e-3 * np.abs(cells.weights).mean()
    raised = int((cells.weights < floor).sum())
    cells = Cells(cells.edges, np.maximum(cells.weights, floor), cells.membership)
    matrix = stiffness(cells) + sp.diags(soft)
    try:
        factored = factorise(matrix, free, dtype, positions=rest)
    except NotPositiveDefinite as error:
        raise InputError(
            "the system of the free vertices is singular even with positive weights: the mesh "
            "spans too many orders of magnitude; see jd.inspect(mesh) and jd.repair(mesh)"
        ) from error
    warnings.warn(
        f"negative or zero weights made the system indefinite: {raised} edge weights were lifted "
        f"to {floor:.3g}. Pass weights of your own to rings() or spokes() to decide otherwise.",
        stacklevel=3,
    )
    return cells, matrix, *factored


# ---------------------------------------------------------------- deform


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
    held = _Held(*(cast(Array, x) for x in given))  # JAX's arrays once they are inside
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


def material(problem: Problem, constant: ArrayLike) -> Float[Array, "n"]:
    """Turn a scale-free, resolution-free material constant into the rigidity of each vertex.

    ``lambda_k = constant * tr(B_k) / 2``: the sum of w |e|^2 over a triangle's edges is twice its
    area, so tr(B_k) / 2 measures the area of the cell. The same constant is the same material on a
    rescaled or refined mesh, which the same lambda is not.

    **Arguments**: problem; constant >= 0, a number or (n,), without unit. **Returns** (n,).
    **Raises** InputError as for rigidity.

    Example:
        >>> import jaxdeform as jd
        >>> problem = jd.precompute(jd.shapes.bar(), [0])
        >>> jd.material(problem, 0.2).shape
        (722,)
    """
    constant = check_rigidity(constant, problem.n_vertices, problem.dtype, name="constant")
    return jnp.asarray(constant) * jnp.maximum(jnp.sum(problem.system.b, axis=0), 0.0) / 2.0


# ---------------------------------------------------------------- checks of the arguments


def check_rigidity(
    rigidity: ArrayLike, n: int, dtype: np.dtype, *, name: str = "rigidity"
) -> Float[Array, "n"] | Float[np.ndarray, "n"]:
    """Return rigidity as one number per vertex, or raise InputError naming what is wrong."""
    array = read_array(rigidity, dtype, name)
    if array.shape not in ((), (n,)):
        raise InputError(
            f"{name} has shape {array.shape}: give one number, or one per vertex, ({n},)"
        )
    if known(array):
        values = np.atleast_1d(np.asarray(array))
        bad = np.flatnonzero(~((values >= 0) & np.isfinite(values)))
        if bad.size:
            where = f" at vertex {bad[0]}" if array.shape else ""
            raise InputError(
                f"{name} is {values[bad[0]]}{where}: it must be a finite number, 0 or more"
            )
    return (jnp if isinstance(array, Array) else np).broadcast_to(array, (n,))


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


# ---------------------------------------------------------------- the iterations


def _evaluate(
    system: System,
    held: _Held,
    p,
    known=None,
    *,
    local: LocalStep,
    normals: bool,
    lanes: int | None = None,
):
    """Evaluate at p; with ``known`` transformations the local step is not run again.

    The last axis of p and held may be (vertex, lane); energies then are those of the lanes.
    """
    run = partial(fit, local) if known is None else partial(local.attach, known)
    w = lanes or 1
    b, free, soft = (jnp.repeat(x, w, axis=-1) for x in (system.b, system.free, system.soft))
    c = system.scatter(p, w)
    if normals:
        t, cells = _fit_with_normals(system, held, local, p, c, known)
    else:
        t = run(c, b, held.rigidity)
        cells = local_energy(t, c, b, held.rigidity, lanes)
    # The factor holds the system's own weights; others enter here only.
    stiff = system.stiffness.apply(p, w) + (held.soft - soft)[None] * p
    pull = system.scatter.adjoint(t, w) + held.soft[None] * held.targets
    scale = total(p * stiff, lanes)
    # tr(p^T A p) holds w |p|^2 of the soft handles; completed to w |p - target|^2.
    springs = total(held.soft[None] * held.targets * (held.targets - 2.0 * p), lanes)
    gradient = jnp.where(free[None], stiff - pull, 0.0)
    # The energy is a small difference of scale, hence its rounding error.
    rounding = 20.0 * jnp.finfo(p.dtype).eps * jnp.abs(scale)
    return Sample(t, gradient, scale + springs + cells, rounding)


def _evaluate_lanes(evaluate, system: System, held: _Held, p: Float[Array, "3 n lanes"]) -> Sample:
    """Evaluate lanes side by side: all arrays, also those of held, have the lanes last."""
    lanes = p.shape[-1]
    flat = jax.tree.map(lambda x: x.reshape(*x.shape[:-2], -1), (held, p))
    at = evaluate(system, *flat, lanes=lanes)
    t, g = by_lane(at.transforms, lanes), by_lane(at.gradient, lanes)
    return at._replace(transforms=t, gradient=g)


def _fit_with_normals(system: System, held: _Held, local: LocalStep, p, c, known):
    """Eq. 4.7: one more edge of weight 1, from n to n'; n' is that of the current vertices.

    The edge changes B, so the cells have other principal frames here.
    """
    rest_normal = vertex_normals(system.rest, system.faces)
    normal = vertex_normals(p, system.faces)
    b = jnp.einsum("iak,ak,jak->kij", system.frames, system.b, system.frames, precision="highest")
    b = b + jnp.einsum("ik,jk->kij", rest_normal, rest_normal, precision="highest")
    moments, frames = jnp.linalg.eigh(b)
    frames = frames * jnp.sign(jnp.linalg.det(frames))[:, None, None]
    moments, frames = moments.T, jnp.moveaxis(frames, 0, -1)
    # From the frames of the problem to these.
    turn = jnp.einsum("iak,ibk->abk", system.frames, frames, precision="highest")
    c = jnp.einsum("abk,ack->bck", turn, c, precision="highest")
    c = c + jnp.einsum("ibk,ik,ck->bck", frames, rest_normal, normal, precision="highest")
    if known is None:
        t = fit(local, c, moments, held.rigidity)
    else:
        t = local.attach(
            jnp.einsum("cak,abk->cbk", known, turn, precision="highest"), c, moments, held.rigidity
        )
    has_normal = jnp.sum(normal * normal, axis=0)
    cells = local_energy(t, c, moments, held.rigidity) + jnp.sum(has_normal)
    return jnp.einsum("cbk,abk->cak", t, turn, precision="highest"), cells


def vertex_normals(positions: Float[Array, "3 n"], faces: Int[Array, "m 3"]) -> Float[Array, "3 n"]:
    """Return area-weighted unit normals; 0 where a vertex has no face."""
    a, b, c = (positions[:, faces[:, k]] for k in range(3))
    face = jnp.cross(b - a, c - a, axis=0)
    total = jnp.zeros_like(positions)
    for k in range(3):
        total = total.at[:, faces[:, k]].add(face)
    square = jnp.sum(total**2, axis=0, keepdims=True)
    return total / jnp.sqrt(jnp.where(square > 0, square, 1.0))


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
    evaluate = partial(_evaluate, local=local, normals=normals)
    if isinstance(adjoint, Implicit):
        p, known, history, steps, code = _implicit(system, held, p, evaluate, solver, adjoint)
    else:
        p, known, history, steps, code = _alternate(system, held, p, evaluate, solver)
    known, energy = _attach_end(evaluate, system, held, p, known, history[steps])
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


def _attach_end(evaluate, system: System, held: _Held, p, known, energy):
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


def _alternate(system: System, held: _Held, p, evaluate, solver: Alternating):
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


def _implicit(system: System, held: _Held, p, evaluate, solver, adjoint: Implicit):
    """Solve by any method, and differentiate grad E(p) = 0 at the end (implicit function).

    ``H dp = -(d grad E / d held) dheld``. The Hessian H = A - K^T dT/dC K is symmetric, so the same
    conjugate gradients serve jvp and vjp. (lax.custom_root would do it too, but traces the
    derivatives even where nobody asks for any: 0.7 s.)
    """

    @jax.custom_jvp
    def root(system, held, p):
        if isinstance(solver, QuasiNewton):
            lanes = partial(_evaluate_lanes, evaluate)
            p, known, history, steps, converged = minimize(lanes, system, held, p, solver)
            code = jnp.where(converged, 1, 2)
        else:
            p, known, history, steps, code = _alternate(system, held, p, evaluate, solver)
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
