"""Telling a minimum from a saddle, and leaving a saddle.

Where a mesh, its handles and its targets are symmetric, a descent stays symmetric. It ends where
the energy is stationary and lowest among symmetric shapes, although a shape that buckles to one
side may lie lower: a saddle. The Hessian tells: a saddle has a direction of negative curvature. A
few steps of Lanczos find it, since it is smooth and far below the other modes. On the bar of 722
vertices the lowest curvature is, after 8 steps: bent by 90 degrees with rigid cells -0.022 (-0.031
after 48), pushed together -0.051 (-0.052); a minimum of rigidity 30 0.079 (0.053), one of rigidity
1 0.37 (0.36).

Tried: a start that the metric has smoothed once more. On tubes it took 27 products with the Hessian
instead of 40, on the bar and the cactus 18 to 40 instead of 12 to 27.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._deformation.metric import Metric, apply_metric
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.system import System
from jaxdeform._linalg.batching import as_member
from jaxdeform._linalg.conjugate_gradients import dot
from jaxdeform._linalg.lanczos import lowest_mode
from jaxdeform._linalg.lbfgs import LbfgsSettings, Minimum
from jaxdeform._linalg.varying import as_varying

# Steps of Lanczos where the sign does not show before.
MOST = 64
# Descents at most, and how far from a saddle the next one starts, in diagonals.
_DESCENTS, _AWAY = 6, 0.02
# Members of a batch that are looked at side by side: each takes 650 bytes a vertex.
_AT_ONCE = 8


class Curvature(NamedTuple):
    """The lowest curvature at a shape, relative to that of the metric, so without unit."""

    value: Any
    """The true one is no higher."""
    along: Any
    """Its direction; 0 where the curvature is not negative."""
    gain: Any
    """<g, M^-1 g>: twice the expected gain of a step of the metric M alone."""


def lowest_curvature(
    energy: ReducedEnergy,
    system: System,
    inputs: Inputs,
    metric: Metric | None,
    p: Float[Array, "3 vertices"],
    transforms: Float[Array, "3 3 vertices"],
    wanted: Bool[Array, ""] | bool = True,
    most: int = MOST,
) -> Curvature:
    """Return the lowest curvature of the reduced energy, as far as its sign needs it, and where.

    Unless ``wanted``, it is 0.
    """

    def look(system, own):
        system, own = as_varying((system, own))
        inputs, metric, p, transforms, wanted = own
        at = lambda x: energy.evaluate(system, inputs, x, transforms).gradient  # noqa: E731
        gradient, hessian = jax.linearize(at, p)
        precondition = partial(apply_metric, system, metric)
        gain = dot(gradient, precondition(gradient))
        # Any vector that is no symmetric one will do.
        index = jnp.arange(p.size, dtype=p.dtype).reshape(p.shape)
        start = jnp.where(system.free[None], jnp.sin(index * (1.0 + 0.37 * index)), 0.0)
        return Curvature(*lowest_mode(hessian, precondition, start, most, wanted), gain)

    def look_at_all(system, own):
        each, size = partial(look, system), own[-1].shape[0]
        if size == 1:  # no loop, which would hide what is known when it is compiled
            out = each(jax.tree.map(lambda x: x[0], own))
            return jax.tree.map(lambda x: x[None], out)
        return jax.lax.map(each, own, batch_size=min(size, _AT_ONCE))

    return as_member(look_at_all, system, (inputs, metric, p, transforms, jnp.asarray(wanted)))


def negative_below(dtype: np.dtype) -> float:
    """Return the curvature from which on it counts as negative: it is known to rounding only."""
    return -1e-5 if dtype == jnp.float64 else -1e-3


class _Way(NamedTuple):
    """A descent that goes on after saddles."""

    descents: Int[Array, ""]
    best: Minimum
    along: Float[Array, "3 vertices"]
    """The way on from the best end, as long as the next try should go."""
    at_saddle: Bool[Array, ""]
    """Whether the best end is known to be one, which a way on would leave for a lower one."""
    in_valley: Bool[Array, ""]
    """Whether the descent stopped in a valley with much left to gain: see `leave_saddles`."""
    tolerance: Float[Array, ""]
    """Of the next descent."""


def leave_saddles(
    descend: Callable[[Float[Array, "3 vertices"], LbfgsSettings], Minimum],
    curvature: Callable[[Array, Array, Array], Curvature],
    start: Float[Array, "3 vertices"],
    size: Float[Array, ""],
    settings: LbfgsSettings,
) -> tuple[Minimum, Bool[Array, ""]]:
    """Descend; from a saddle go on along its direction of negative curvature.

    ``size`` is that of the mesh. Returns where it ended, and whether that is a saddle still. Where
    a way on ends higher, as it may in a crumpled mesh, a shorter one is tried. Where no way on
    gains more than the tolerance, the saddle counts as the end.

    In a long valley a step of the metric gains little though much is to be gained: with the lowest
    curvature c, up to 1 / c times as much. Where that is above 100 tolerances, it goes on with a
    lower one, in float64. (A plate stopped at an energy of 36.03 with c = 0.0015; the valley ends
    at 24.77.)
    """
    negative = negative_below(start.dtype)
    # The energy is a difference of sums some 600 times as large.
    rounding = 1e3 * jnp.finfo(start.dtype).eps

    def descend_on(way: _Way) -> _Way:
        first = way.descents == 0
        place = jnp.where(first, start, way.best.p + way.along)
        end = descend(place, settings._replace(tolerance=way.tolerance))
        old, new = way.best.energy[way.best.steps], end.energy[end.steps]
        margin = jnp.maximum(settings.tolerance, rounding) * jnp.abs(old)
        lower, higher = first | (new < old - margin), ~first & ~(new <= old + margin)
        value, along, gain = curvature(end.p, end.transforms, end.converged)
        longest = jnp.sqrt(jnp.max(jnp.sum(along**2, axis=0)))
        along = along * (_AWAY * size / jnp.where(longest > 0, longest, 1.0))
        both = jax.tree.map(partial(jnp.where, first), end, _joined(way.best, end))
        best = jax.tree.map(partial(jnp.where, lower), both, way.best)
        at_saddle = jnp.where(lower, end.converged & (value < negative), higher)
        finer = 10.0 * settings.tolerance * value
        in_valley = lower & end.converged & (finer > rounding) & (finer < settings.tolerance)
        in_valley &= gain > 10.0 * finer * jnp.abs(new)
        along = jnp.where(lower, along, 0.2 * way.along)
        tolerance = jnp.where(in_valley, finer, settings.tolerance)
        return _Way(way.descents + 1, best, along, at_saddle, in_valley, tolerance)

    unknown = Minimum.unknown(start, settings)
    begin = _Way(
        jnp.zeros((), jnp.int32),
        unknown,
        jnp.zeros_like(start),
        jnp.asarray(True),
        jnp.asarray(False),
        jnp.asarray(settings.tolerance, start.dtype),
    )
    going = lambda way: (way.at_saddle | way.in_valley) & (way.descents < _DESCENTS)  # noqa: E731
    end = jax.lax.while_loop(going, descend_on, as_varying(begin))
    return end.best, end.at_saddle


def _joined(before: Minimum, after: Minimum) -> Minimum:
    """Return the end of the second with the energies of both; the step between them is one too."""
    count = before.energy.shape[0]
    index, first = jnp.arange(count, dtype=jnp.int32), before.steps + 1
    later = after.energy[jnp.maximum(index - first, 0)]
    steps = jnp.minimum(first + after.steps, count - 1)
    energy = jnp.where(index < first, before.energy, later)
    energy = energy.at[steps].set(after.energy[after.steps])
    return after._replace(energy=energy, steps=steps)
