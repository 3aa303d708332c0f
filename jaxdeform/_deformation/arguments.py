"""What a deformation is given: arrays and settings, checked, and spread over the mesh."""

from typing import Any, NamedTuple, cast

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdeform._arrays import as_array, is_concrete
from jaxdeform._checks import check_flag
from jaxdeform._deformation.alternating import Alternating
from jaxdeform._deformation.descent import Adjoint, Solver, choose_adjoint
from jaxdeform._deformation.geometry import Geometry, geometry_of, graph_of
from jaxdeform._deformation.local_step_check import check_local_step
from jaxdeform._deformation.numbers import Numbers, numbers_of, with_numbers, without_numbers
from jaxdeform._deformation.problem import Problem, fits_cells
from jaxdeform._deformation.quasi_newton import QuasiNewton
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._errors import ArrayLike, InputError, have
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._values import (
    check_one_per_handle,
    read_host_positions,
    read_positions,
    read_rigidity,
)


class DeformSettings(NamedTuple):
    """What does not depend on values, and is compiled into the program."""

    energy: ReducedEnergy
    solver: Solver
    adjoint: Adjoint

    def apart(self, dtype: np.dtype) -> tuple[tuple[Numbers, Numbers], "DeformSettings"]:
        """Return the numbers of solver and adjoint, and the settings without them."""
        numbers = numbers_of(self.solver, dtype), numbers_of(self.adjoint, dtype)
        solver = without_numbers(self.solver, numbers[0])
        return numbers, DeformSettings(
            self.energy, solver, without_numbers(self.adjoint, numbers[1])
        )

    def together(self, numbers: tuple[Numbers, Numbers]) -> "DeformSettings":
        """Return the settings with these numbers."""
        solver = with_numbers(self.solver, numbers[0])
        return DeformSettings(self.energy, solver, with_numbers(self.adjoint, numbers[1]))


def read_settings(
    dtype: np.dtype, local: Any, solver: Any, adjoint: Any, normals: Any
) -> DeformSettings:
    """Return the settings of a deformation, or raise InputError: they exclude each other."""
    check_flag("normals", normals)
    if solver is None:
        solver = Alternating() if normals else QuasiNewton()
    adjoint = choose_adjoint(solver, adjoint)
    if normals and (solver.needs_one_energy or adjoint.needs_one_energy):
        raise InputError(
            "with normals the iteration is not the descent of one energy (n' lags behind): use "
            "solver=Alternating() and adjoint=Unrolled()"
        )
    check_local_step(local, dtype)
    return DeformSettings(ReducedEnergy(local, normals), solver, adjoint)


def read_inputs(
    problem: Problem,
    targets: Float[Array, "*frames 3 handles"] | Float[np.ndarray, "*frames 3 handles"],
    rigidity: ArrayLike,
    handle_weights: ArrayLike | None,
) -> Inputs:
    """Check the rigidity and the weights, and spread everything over all vertices."""
    rigidity = spread_rigidity(problem, rigidity)
    spread = spread_targets(problem, targets)
    soft = read_weights(problem, handle_weights)
    # NumPy's arrays are JAX's once they are inside.
    return Inputs(cast(Array, spread), cast(Array, rigidity), soft)


def spread_rigidity(
    problem: Problem, rigidity: ArrayLike
) -> Float[Array, "vertices"] | Float[np.ndarray, "vertices"]:
    """Check the rigidity, and spread it over the arrays of the system.

    It is NaN, which ends in ``bad_input``, if JAX traces the problem and its arrays turn out to be
    of another mesh. (Known ones are refused by `check_problem`.)
    """
    size = problem.bucket
    out = fill_up(read_rigidity(rigidity, problem.n_vertices, problem.dtype, size=size), size)
    if is_concrete(problem):
        return out
    return jnp.where(fits_cells(problem), out, jnp.asarray(jnp.nan, problem.dtype))


def read_vertices(
    problem: Problem, name: str, vertices: ArrayLike
) -> Float[Array, "3 vertices"] | Float[np.ndarray, "3 vertices"]:
    """Read positions of all vertices relative to the centre of the rest shape, and fill them up."""
    given = from_center(problem, name, vertices, (problem.n_vertices, 3), "vertex")
    return fill_up(given, problem.bucket)


def from_center(
    problem: Problem, name: str, value: ArrayLike, shape: tuple[int, ...], unit: str
) -> Float[Array, "*frames 3 rows"] | Float[np.ndarray, "*frames 3 rows"]:
    """Read positions (*frames, rows, 3) relative to the centre of the rest shape.

    Known values are subtracted in float64, so that a float32 problem far from the origin loses no
    digit of where its handles go.
    """
    if problem.cells is None or (isinstance(value, Array) and not is_concrete(value)):
        given = read_positions(name, value, shape, problem.dtype, unit)
        center = problem.system.center.reshape((1,) * (len(shape) - 1) + (3,))
        return jnp.swapaxes(jnp.asarray(given - center), -1, -2)
    given = read_host_positions(name, value, shape, unit) - problem.mesh.center
    with np.errstate(over="ignore"):
        given = given.swapaxes(-1, -2).astype(problem.dtype)
    if not np.isfinite(given).all():
        raise InputError(f"{name} are too large for {problem.dtype}: use another unit of length")
    return given


def spread_targets(
    problem: Problem,
    targets: Float[Array, "*frames 3 handles"] | Float[np.ndarray, "*frames 3 handles"],
) -> Float[Array, "*frames 3 vertices"] | Float[np.ndarray, "*frames 3 vertices"]:
    """Spread the targets over an array of all vertices, in NumPy where they are known.

    So the compiled code sees shapes that depend on the mesh alone: another number of handles does
    not compile anything anew.
    """
    system, handles = problem.system, problem.handles
    shape = *targets.shape[:-1], problem.bucket
    if is_concrete(targets, system.rest, handles):
        spread = np.array(np.broadcast_to(system.rest, shape))
        spread[..., np.asarray(handles)] = targets
        return spread
    return jnp.broadcast_to(system.rest, shape).at[..., handles].set(targets)


def read_weights(problem: Problem, weights: ArrayLike | None) -> Float[Array, "vertices"]:
    """Spread the weights of soft handles over all vertices, 0 at hard ones and elsewhere."""
    system, handles = problem.system, problem.handles
    if weights is None:
        return system.soft
    given = as_array(weights, problem.dtype, "handle_weights")
    given = jnp.broadcast_to(check_one_per_handle(given, handles.shape), handles.shape)
    given = jnp.where(system.free[handles], given, 0.0)
    if is_concrete(given, system.soft):
        most = np.asarray(system.soft)[np.asarray(handles)]
        bad = np.flatnonzero(~((np.asarray(given) >= 0) & (np.asarray(given) <= most)))
        if bad.size:
            raise InputError(
                f"the weight of handle {handles[bad[0]]} is {given[bad[0]]}: give 0 to "
                f"{most[bad[0]]}, the weight that it had in precompute"
            )
    return jnp.zeros_like(system.soft).at[handles].set(given)


def read_geometry(
    problem: Problem, rest: ArrayLike | None, edge_weights: ArrayLike | None
) -> Geometry:
    """Return the geometry from the problem's own rest positions and weights, or raise InputError.

    They are given only for derivatives with respect to them. Other values than the problem's are
    refused.
    """
    cells, dtype = problem.own_cells, problem.dtype
    graph = graph_of(cells, dtype)
    own = (
        ("rest", rest, problem.vertices, "vertex"),
        ("edge_weights", edge_weights, cells.weights, "edge"),
    )
    for name, value, known, unit in own:
        if value is None:
            continue
        given = as_array(value, dtype, name)
        if given.shape != known.shape:
            raise InputError(f"{name} {have(name)} shape {given.shape}, expected {known.shape}")
        if is_concrete(given):
            size = max(np.abs(known).max(), 1e-300)
            far = ~(np.abs(np.asarray(given) - known) <= 1e3 * np.finfo(dtype).eps * size)
            if far.any():
                raise InputError(
                    f"{name} of {unit} {np.argwhere(far)[0][0]} are not the problem's own: they "
                    "are given only for derivatives; call precompute for another rest shape"
                )
    at = problem.system.rest if rest is None else read_vertices(problem, "rest", rest)
    weights = cells.weights if edge_weights is None else edge_weights
    weights = as_array(weights, dtype, "edge_weights")
    return geometry_of(graph, jnp.asarray(at), weights, edge_weights is not None)
