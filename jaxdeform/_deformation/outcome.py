"""What is said of a deformation: its result, and the cells that are inside out."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdeform._deformation.descent import Descent
from jaxdeform._deformation.reduced_energy import Inputs
from jaxdeform._deformation.system import System
from jaxdeform._result import Result

# A vertex further than this many diagonals from the box of the mesh and its targets is no answer.
_FAR = 10.0


def outcome_of(system: System, inputs: Inputs, end: Descent) -> Result:
    """Return the result of a descent: its own, unless the input or the end is no good.

    Inside jit the values of arguments cannot be checked by an exception, so they are here.
    """
    energy = end.energy[end.steps]
    finite = jnp.isfinite(energy) & jnp.all(jnp.isfinite(end.positions))
    moved = jnp.where(system.led[None], inputs.targets, system.rest)
    both = jnp.concatenate([system.rest, moved], axis=1)
    low, high = both.min(axis=1, keepdims=True), both.max(axis=1, keepdims=True)
    margin = _FAR * jnp.sqrt(jnp.sum((high - low) ** 2))
    near = jnp.all((end.positions >= low - margin) & (end.positions <= high + margin))
    stretch = jnp.sum(end.transforms**2, axis=0)
    size = jnp.sum(jnp.abs(system.principal_moments) * stretch)  # of the terms that make the energy
    proportionate = near & (energy >= -jnp.sqrt(jnp.finfo(energy.dtype).eps) * size)
    valid = (
        jnp.all(jnp.isfinite(inputs.targets))
        & jnp.all((inputs.rigidity >= 0) & jnp.isfinite(inputs.rigidity))
        & jnp.all((inputs.soft >= 0) & (inputs.soft <= system.soft))
    )
    if inputs.geometry is not None:
        given = inputs.geometry
        far = jnp.max(jnp.abs(system.center))  # from the origin: so much was rounded
        known = (given.rest, system.rest, far), (given.weights, given.graph.weights, 0.0)
        for value, own, more in known:
            allowed = max(1e-6, 1e3 * float(jnp.finfo(own.dtype).eps))
            valid &= jnp.all(jnp.abs(value - own) <= allowed * (jnp.max(jnp.abs(own)) + more))
    result = Result.where(finite & ~proportionate, Result.out_of_proportion, end.result)
    result = Result.where(finite, result, Result.not_finite)
    return Result.where(valid, result, Result.bad_input)


def inside_out(transforms: Float[Array, "3 3 vertices"]) -> Int[Array, ""]:
    """Return the number of cells whose transformation does not keep its orientation: det T <= 0."""
    a, b, c = transforms
    return jnp.sum(jnp.sum(a * jnp.cross(b, c, axis=0), axis=0) <= 0.0, dtype=jnp.int32)
