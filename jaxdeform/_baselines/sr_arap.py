"""ARAP with smooth rotations in one call (Levi and Gotsman 2015)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._arrays import read_host_array
from jaxdeform._baselines.smooth_rotations import (
    SmoothEnergy,
    to_convergence,
    unrolled,
    with_derivative_of_minimum,
)
from jaxdeform._checks import check_count, check_flag, check_tolerance, check_type
from jaxdeform._deformation.arguments import from_center, read_inputs, read_vertices
from jaxdeform._deformation.problem import precompute
from jaxdeform._deformation.reduced_energy import Inputs
from jaxdeform._deformation.solve import (
    Solution,
    cut_to_mesh,
    guess_at_once,
    solution_of,
    without_derivative,
)
from jaxdeform._errors import ArrayLike
from jaxdeform._linalg.varying import as_varying
from jaxdeform._linalg.xla import AS_FAST, quick_jit
from jaxdeform._mesh.cells import spokes
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._result import check_result
from jaxdeform._values import read_rigidity


def sr_arap(
    mesh: Mesh,
    handles: ArrayLike,
    targets: ArrayLike,
    alpha: ArrayLike = 0.02,
    *,
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
    tolerance: float = 1e-8,
    max_steps: int = 5000,
    steps: int | None = None,
    throw: bool = False,
) -> Solution:
    """Deform as rigidly as possible with rotations that vary smoothly, once.

    Levi and Gotsman, "Smooth rotation enhanced as-rigid-as-possible mesh animation" (2015). To the
    energy of `arap` it adds ``sum_{edges ij} (alpha_i + alpha_j) / 2 b_ij |R_i - R_j|_F^2`` with
    ``b_ij = area (1 / n_i + 1 / n_j) / 2``: area is that of the mesh, n_i the number of neighbours
    of vertex i. Where all vertices have the same number of neighbours, alpha is that of CGAL. (CGAL
    gives vertex i the weight ``1 / n_i`` alone, so that its steps are no descent of an energy. On
    the cactus, whose vertices differ, the ends at 0.02 lie 8e-5 of the diagonal apart, those at 0
    4e-8, with the edge weights of CGAL.)

    Local and global steps alternate, and no step raises the energy. Unlike `arap`, it does not
    look whether the end is a saddle.

    A function of the targets and the start, under jit and vmap too. By default it goes to
    convergence, and the derivatives to the targets are those of the minimum (jvp, grad and
    higher). With ``steps`` they are those of that many steps, to the targets and the start.
    Nothing else has a derivative.

    **Arguments**

    - mesh: the rest shape.
    - handles: (handles,) vertex indices, a mask or a selection.
    - targets: (handles, 3), in the unit of the mesh.
    - alpha: a number or one per vertex (vertices,), 0 or more, without unit. 0 is ARAP; the larger,
      the more equal are the rotations of neighbours.
    - weights: (edges,), as in `spokes`; by default cotangent weights, where negative ones count
      as 0.
    - start: (vertices, 3), the first guess; by default Laplacian editing.
    - tolerance: stop once a step gains less than this fraction of the energy.
    - max_steps: stop after that many steps all the same.
    - steps: take this many steps instead, whatever they gain.
    - throw: raise an error if the result is not ``ok``, also inside jit.

    **Returns** a `Solution`: ``transforms`` are the rotations, ``energy`` includes their term.
    Numerical trouble comes back in its ``result``.

    **Raises** InputError as `precompute` does; targets or start of the wrong shape or not finite;
    alpha, the tolerance or a number of steps out of range.

    Example:
        >>> import jaxdeform as jd
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> out = jd.sr_arap(mesh, handles, jd.bend(mesh.vertices[handles], 90.0))
        >>> out.vertices.shape
        (722, 3)
    """
    check_type("mesh", mesh, Mesh)
    alpha = read_host_array(alpha, np.float64, "alpha")
    alpha = np.asarray(read_rigidity(alpha, mesh.n_vertices, alpha.dtype, name="alpha"))
    tolerance = check_tolerance("tolerance", tolerance)
    max_steps = check_count("max_steps", max_steps)
    check_flag("throw", throw)
    if steps is not None:
        steps = check_count("steps", steps)
    problem = precompute(mesh, handles, cells=spokes(mesh, weights=weights))
    relative = from_center(problem, "targets", targets, (len(problem.handles), 3), "handle")
    inputs = read_inputs(problem, relative, 0.0, None)
    if start is not None:
        start = read_vertices(problem, "start", start)
    else:
        start = guess_at_once(problem.system, inputs.targets)
    energy = SmoothEnergy.build(problem.system, mesh, alpha, problem.dtype)
    accuracy = np.asarray(tolerance, problem.dtype)
    settings = {"tolerance": accuracy, "max_steps": max_steps, "steps": steps}
    out = cut_to_mesh(_solve_at_once(energy, inputs, start, **settings), problem.n_vertices)
    return check_result(out, throw)


def _solve(
    energy: SmoothEnergy,
    inputs: Inputs,
    start: Float[Array, "3 vertices"] | Float[np.ndarray, "3 vertices"],
    *,
    tolerance: Float[Array, ""],
    max_steps: int,
    steps: int | None,
) -> Solution:
    energy = energy._replace(system=without_derivative(energy.system))
    energy, inputs, start = as_varying((energy, inputs, start))
    system, targets = energy.system, inputs.targets
    start = jnp.where(system.free[None], start, targets)
    if steps is None:
        known = jax.lax.stop_gradient((energy, start))
        end = jax.lax.stop_gradient(to_convergence(*known, tolerance, max_steps))
        p, t = with_derivative_of_minimum(energy, targets, end.positions, end.transforms)
        value, _ = energy.value(p, t, energy.pull(t))
        end = end._replace(positions=p, transforms=t)
    else:
        end = unrolled(energy, start, steps)
        value = end.energy[end.steps]
    return solution_of(system, inputs, end, value)


_solve_at_once = quick_jit(static=("max_steps", "steps"), options=AS_FAST)(_solve)
