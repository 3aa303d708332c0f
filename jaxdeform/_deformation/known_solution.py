"""A known solution as a function of targets and rigidity, without the loop that found it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.arguments import read_rigidity, spread_targets
from jaxdeform._deformation.local_step import Newton
from jaxdeform._deformation.problem import Problem
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._linalg.buckets import fill_up


def minimum_near(
    problem: Problem,
    targets: Float[Array, "handles 3"],
    rigidity: Float[Array, "vertices"],
    vertices: Float[Array, "vertices 3"],
    transforms: Float[Array, "vertices 3 3"],
    adjoint: Implicit,
) -> Float[Array, "vertices 3"]:
    """Return the vertices that ``deform`` returned for these arguments, with their derivatives.

    Where a derivative is asked for, they are those of the minimum next to them, as of ``deform``.
    Compiling takes a third of the time of ``deform`` with a derivative, because neither the solver
    nor the local step is part of the program.
    """
    system = problem.system
    center = system.center[:, None]
    relative = jnp.asarray(targets).T - center
    known = jnp.asarray(read_rigidity(problem, rigidity))
    inputs = Inputs(jnp.asarray(spread_targets(problem, relative)), known, system.soft)
    axes = system.principal_axes
    count, size = problem.n_vertices, problem.bucket
    t = jnp.einsum("kaj,jik->aik", transforms, axes[..., :count], precision="highest")
    p, t = fill_up(jnp.asarray(vertices).T - center, size), fill_up(t, size)
    p, _ = adjoint.minimum(ReducedEnergy(Newton()), system, inputs, p, t)
    return (p[:, :count] + center).T
