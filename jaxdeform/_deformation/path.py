"""A path: many deformations of one mesh, each of which starts from the one before."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._arrays import is_concrete, read_array, read_numbers
from jaxdeform._checks import check_flag, check_function
from jaxdeform._deformation.arguments import (
    DeformSettings,
    from_center,
    read_inputs,
    read_settings,
    read_vertices,
)
from jaxdeform._deformation.descent import Adjoint, Solver
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.problem import Problem, check_problem
from jaxdeform._deformation.reduced_energy import Inputs
from jaxdeform._deformation.solve import Solution, cut_to_mesh, descend, guess, without_derivative
from jaxdeform._deformation.system import System
from jaxdeform._errors import ArrayLike, InputError
from jaxdeform._linalg.varying import as_varying
from jaxdeform._linalg.waiting import wait_for
from jaxdeform._linalg.xla import AS_FAST, quick_jit
from jaxdeform._result import Result, check_result


def deform_path(
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
    throw: bool = False,
    progress: Callable[[int, int], Any] | None = None,
) -> Solution:
    """Deform the mesh frame by frame along a path of its handles; each frame starts from the last.

    The energy (Eq. 4.4) has many minima. ``deform`` finds one near its first guess, so handles
    turned by 360 degrees give it the rest shape. A path finds the minimum that the shape gets to
    when the handles go there in small steps. It is what a drag and an animation are.

    A pure function of arrays, like `deform`: it works under jit, vmap (over targets,
    rigidity, start), grad and jvp. All frames run in one compiled loop; another number of frames
    compiles anew. With ``Implicit()`` the derivatives of a frame are those of its own targets, not
    of the frames before: a minimum does not depend on where it was found from.

    On a path the energy changes by the work of the handles. Where it does not, the shape has jumped
    to another equilibrium, such as that of a turn less, and ``jumped`` says so. Nothing is said of
    the first frame, nor where this frame or the last has not converged (``Alternating`` never has).
    Steps of 45 degrees are too large to tell.

    A frame whose result is ``not_finite``, ``out_of_proportion`` or ``bad_input`` is not started
    from. The next one starts from the last frame before it that has none of these.

    **Arguments**

    - problem: from `precompute`.
    - targets: (frames, handles, 3) positions of the handles in each frame, in the order of
      ``problem.handles``; an array or a list over frames. Steps of 5 to 10 degrees are small.
    - rigidity: a number or one per vertex (vertices,), the same in all frames. (For one that
      changes call ``deform`` with ``start=`` of the last frame.)
    - start: (vertices, 3) the shape before the first frame; by default the rest shape.
    - local, solver, handle_weights, normals, adjoint, throw: as in `deform`.
    - progress: called with the number of frames done and of all frames, after each. The frames then
      run one by one, which compiles once for any number of them; not inside jit, vmap or grad.

    **Returns** a `Solution` whose arrays have a leading axis of frames, also ``result``,
    ``ok``, ``flipped`` and ``jumped``. ``jax.tree.map(lambda x: x[k], out)`` is the solution of
    frame k.

    **Raises** InputError: as `deform`; targets without a frame; progress while JAX traces.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> problem = jd.precompute(mesh, handles)
        >>> points = mesh.vertices[handles.vertices]
        >>> turn = [jd.twist(points, degrees) for degrees in np.linspace(0, 360, 37)]
        >>> out = jd.deform_path(problem, turn, rigidity=1000.0)
        >>> out.vertices.shape, bool(out.ok.all()), bool(out.jumped.any())
        ((37, 722, 3), True, False)
        >>> round(float(out.energy[-1, -1]) / float(out.energy[18, -1]), 1)
        1.7
    """
    check_problem(problem)
    check_flag("throw", throw)
    check_function("progress", progress, "frames done, frames")
    settings = read_settings(problem.dtype, local, solver, adjoint, normals)
    relative = _from_center(problem, targets)
    inputs = read_inputs(problem, relative, rigidity, handle_weights)
    system = problem.system
    shape = system.rest if start is None else read_vertices(problem, "start", start)
    last = _Last.of(shape)
    if progress is None:
        _, out = _follow(system, inputs, last, *settings.apart(problem.dtype))
    else:
        if not is_concrete(system, inputs, last):
            raise InputError(
                "progress is told while the frames are computed, not while JAX traces (jit, vmap, "
                "grad): leave it out there"
            )
        out = _follow_slowly(system, inputs, last, settings.apart(problem.dtype), progress)
    out = cut_to_mesh(out, problem.n_vertices)
    return check_result(out, throw)


def _from_center(problem: Problem, targets: ArrayLike) -> Float[Array, "frames 3 handles"] | Any:
    """Read the targets of all frames, relative to the centre of the rest shape."""
    if isinstance(targets, list | tuple) and any(isinstance(x, jax.Array) for x in targets):
        targets = read_array(targets, problem.dtype, "targets")
    elif not isinstance(targets, jax.Array):
        targets = read_numbers(targets, "targets")
    shape, rows = targets.shape, len(problem.handles)
    if len(shape) != 3 or not shape[0] or shape[1:] != (rows, 3):
        raise InputError(
            f"targets have shape {shape}: give (frames, {rows}, 3), the targets of each frame, at "
            "least one"
        )
    return from_center(problem, "targets", targets, shape, "frame")


class _Last(NamedTuple):
    """The last sound frame, and how the shape came there from the one before."""

    positions: Float[Array, "3 vertices"]
    targets: Float[Array, "3 vertices"]
    moved: Float[Array, "3 vertices"]
    pulled: Float[Array, "3 vertices"]
    """Change of the targets that moved it."""
    slope: Float[Array, "3 vertices"]
    """Of the energy to the targets."""
    energy: Float[Array, ""]
    """-inf unless the frame converged: then nothing is said of the next one."""

    @staticmethod
    def of(positions: Any) -> "_Last":
        """Return the state before the first frame: a shape whose handles are where they are."""
        zeros = cast(Array, np.zeros(positions.shape, positions.dtype))
        unknown = cast(Array, np.full((), -np.inf, positions.dtype))
        return _Last(positions, positions, zeros, zeros, zeros, unknown)

    def start_of_next(
        self, system: System, targets: Float[Array, "3 vertices"]
    ) -> Float[Array, "3 vertices"]:
        """Return the start of the next frame.

        The handles' new motion is split into a multiple of their last one and the rest. The shape
        goes on as it moved last, by that multiple, and follows the rest as Laplacian editing says.
        So a steady path is extrapolated, a pause stays, a way back goes back, and a jump is led as
        in ``deform`` (which is the first frame from the rest shape). The bound on the multiple
        keeps what is left of rounding in a pause from being magnified.

        Iterations of QuasiNewton() for all frames of the bar, at rigidity_from_material 10, 0.2
        and 0.01. From the last vertices alone: twist of 180 degrees in 60 frames 1976, 1019, 500;
        jittery drag 667, 440, 244. With Laplacian editing of the whole motion: 1819, 964, 471; 525,
        364, 200. This: 619, 407, 227; 500, 343, 192. (A multiple of 1 always, at 10: 614 for the
        twist, 549 for the drag, and 658 instead of 513 for a twist with ease in and out.)
        docs/paths.md has more.
        """
        pull = targets - self.targets
        square = jnp.sum(self.pulled**2)
        share = jnp.sum(pull * self.pulled) / jnp.where(square > 0, square, 1.0)
        share = jnp.clip(share, -1.0, 2.0)
        rest = guess(system, pull - share * self.pulled)
        return self.positions + share * self.moved + rest

    def then(self, system: System, targets, positions, out: Solution) -> tuple["_Last", Solution]:
        """Return the state after a frame, and the frame with what is said of a jump.

        The state changes only if the frame is sound.
        """
        known = jax.lax.stop_gradient((system, positions, out.transforms))
        slope, rounding = _slope(*known)
        moved, pulled = positions - self.positions, targets - self.targets
        energy, pull = jax.lax.stop_gradient((out.energy[-1], pulled))
        ends = jnp.sum(self.slope * pull), jnp.sum(slope * pull)
        gap = jnp.abs(energy - self.energy - 0.5 * (ends[0] + ends[1]))
        size = jnp.maximum(jnp.abs(energy), jnp.abs(self.energy))
        allowed = _JUMP * size + 0.25 * jnp.abs(ends[1] - ends[0]) + rounding
        at_minimum = out.result == Result.converged
        out = dataclasses.replace(out, jumped=at_minimum & (gap > allowed))
        energy = jnp.where(at_minimum, energy, -jnp.inf)
        new = _Last(positions, targets, moved, pulled, slope, energy)
        sound = ~jnp.any(jnp.stack([out.result == member for member in _UNSOUND]))
        return jax.tree.map(lambda x, old: jnp.where(sound, x, old), new, self), out


def _slope(
    system: System, p: Float[Array, "3 vertices"], transforms: Float[Array, "vertices 3 3"]
) -> tuple[Float[Array, "3 vertices"], Float[Array, ""]]:
    """Return the slope of the energy to the targets, and a bound on the energy's rounding error.

    At a minimum it is the force on the handles, which the energy of the cells makes (without the
    pull of soft ones): ``2 (A p' - K^T T)``.
    """
    t = system.into_axes(jnp.moveaxis(transforms, 0, -1))
    stiff = system.stiffness.apply(p) - system.soft[None] * p
    scale = jnp.abs(jnp.sum(p * stiff))
    return 2.0 * (stiff - system.covariance.transpose(t)), 1e2 * jnp.finfo(p.dtype).eps * scale


# A frame has jumped if its energy differs by more than this part of it from what the work of the
# handles makes (and half of what the slopes at both ends of the step leave open). Bars, twisted by
# 720 degrees in steps of 2.5 to 30, twisted back, and bent: by at most 0.05 where the shape
# follows, 0.18 to 0.99 where it slips (once 0.04, between two larger ones).
_JUMP = 0.1

_UNSOUND = Result.not_finite, Result.out_of_proportion, Result.bad_input


@quick_jit(static=("settings",), options=AS_FAST)
def _follow(
    system: System, inputs: Inputs, last: _Last, numbers: Any, settings: DeformSettings
) -> tuple[_Last, Solution]:
    """Run all frames of ``inputs.targets`` (frames, 3, vertices), and return where they end."""
    system, inputs, last = as_varying((without_derivative(system), inputs, last))
    led, settings = system.led[None], settings.together(numbers)

    def frame(last: _Last, targets: Float[Array, "3 vertices"]):
        goal = jnp.where(led, targets, last.targets)
        first = last.start_of_next(system, goal)
        out, p = descend(system, inputs._replace(targets=targets), first, settings)
        return last.then(system, goal, p, out)

    return jax.lax.scan(frame, last, inputs.targets)


def _follow_slowly(
    system: System,
    inputs: Inputs,
    last: _Last,
    settings: tuple[Any, DeformSettings],
    progress: Callable[[int, int], Any],
) -> Solution:
    """Run the frames one by one, and tell of each."""
    frames = inputs.targets.shape[0]
    done = []
    for k in range(frames):
        one = inputs._replace(targets=inputs.targets[k : k + 1])
        last, out = wait_for(_follow(system, one, last, *settings))
        done.append(out)
        progress(k + 1, frames)
    return jax.tree.map(lambda *x: jnp.concatenate(x), *done)
