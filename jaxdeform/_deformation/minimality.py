"""Whether a deformed shape is a minimum of the energy: the public question."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdeform._deformation.arguments import (
    from_center,
    read_inputs,
    read_settings,
    read_vertices,
)
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.metric import metric_of
from jaxdeform._deformation.problem import Problem, check_problem
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.saddles import lowest_curvature, negative_below
from jaxdeform._deformation.system import System
from jaxdeform._errors import ArrayLike

# More steps of Lanczos than a descent takes at its end.
_MOST = 100
# A step that would gain more than this fraction of the energy: the shape is still on its way.
_STATIONARY = 1e-4


def is_minimum(
    problem: Problem,
    targets: ArrayLike,
    rigidity: ArrayLike,
    vertices: ArrayLike,
    *,
    local: LocalStep = Newton(),  # noqa: B008 (frozen)
    handle_weights: ArrayLike | None = None,
) -> Bool[Array, ""]:
    """Return whether a shape is a minimum of the reduced energy, and not a saddle.

    It is one if the shape is stationary (a step would gain less than 1e-4 of the energy) and the
    Hessian has no direction of negative curvature, as far as 100 steps of Lanczos see. ``deform``
    looks too, with fewer steps, and leaves saddles that it finds. There may be lower minima.

    **Arguments**: problem, targets, rigidity, local and handle_weights as in `deform`; vertices
    (vertices, 3), the shape, with its handles on their targets.

    **Returns** a boolean. **Raises** InputError as `deform` does. It works under jit and vmap.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> problem = jd.precompute(mesh, handles)
        >>> targets = jd.bend(mesh.vertices[handles], 90.0)
        >>> out = jd.deform(problem, targets, 1.0)
        >>> bool(jd.is_minimum(problem, targets, 1.0, out.vertices))
        True
    """
    check_problem(problem)
    energy = read_settings(problem.dtype, local, None, None, False).energy
    moved = from_center(problem, "targets", targets, (len(problem.handles), 3), "handle")
    inputs = read_inputs(problem, moved, rigidity, handle_weights)
    shape = read_vertices(problem, "vertices", vertices)
    return _look(problem.system, inputs, jnp.asarray(shape), energy)


@partial(jax.jit, static_argnames=("energy",))
def _look(
    system: System, inputs: Inputs, shape: Float[Array, "3 vertices"], energy: ReducedEnergy
) -> Bool[Array, ""]:
    system, inputs, shape = jax.lax.stop_gradient((system, inputs, shape))
    p = jnp.where(system.free[None], shape, inputs.targets)
    at = energy.evaluate(system, inputs, p)
    metric = metric_of(system, energy.local, inputs.rigidity)
    found = lowest_curvature(energy, system, inputs, metric, p, at.transforms, most=_MOST)
    stationary = found.gain <= _STATIONARY * jnp.abs(at.energy) + at.rounding
    return stationary & (found.value >= negative_below(shape.dtype))
