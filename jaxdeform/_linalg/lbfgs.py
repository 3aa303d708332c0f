"""Preconditioned L-BFGS for one minimisation or a queue of them.

This is the engine behind `QuasiNewton`. All it knows about meshes is that positions are
(3, vertices).

Under vmap, the general rule for loops would run every member of the batch until the slowest is
done, and select between old and new values of everything in every iteration. For 64 bars, of which
the slowest takes twice the mean, each bar then takes 6 times as long as one bar alone. Here the
batch is a queue instead: a few slots iterate together, and a slot whose member is done takes the
next one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._linalg.batching import as_member
from jaxdeform._linalg.varying import as_varying
from jaxdeform._linalg.xla import after_reads, has_accelerator, without_fusion

# How many members of the batch iterate together. More slots wait longer for each other at the end
# and outgrow the caches; fewer leave cores idle. Each of 64 bars takes 10.5, 10.3, 11.2, 13.7 and
# 16.1 ms with 8, 12, 16, 24 and 32 slots. Tried: going down to 4 slots once the queue is empty. It
# would save a tenth of the time but take twice as long to compile.
SLOTS = 12

# On an accelerator, use as many slots as have this many vertices in total, enough to fill it. Their
# arrays then take about 4 GB in float64. (That is estimated.) An H200 deforms 2,470, 3,130 and
# 3,070 bars a second, of 1,024, with 128, 256 and 1,024 slots.
VERTICES_AT_ONCE = 1 << 22


class LbfgsSettings(NamedTuple):
    """When to stop, and how many steps to remember; see `QuasiNewton`."""

    tolerance: float | Float[Array, "*members"]
    max_steps: int
    history_length: int


class Sample(NamedTuple):
    """The result of an evaluation at p, for one p or for a batch (the last axis)."""

    transforms: Float[Array, "3 3 vertices *batch"]
    gradient: Float[Array, "3 vertices *batch"]
    """Half the gradient of the reduced energy, A p - K^T T; 0 at fixed vertices."""
    energy: Float[Array, "*batch"]
    rounding: Float[Array, "*batch"]
    """Two energies that differ by less than this differ only by rounding."""


class Function(NamedTuple):
    """What is minimised, for a batch of members."""

    evaluate: Callable[[Any, Any, Array], Sample]
    """Of (system, inputs, p); the members are the last axis of inputs, p and the result."""
    metric: Callable[[Any, Any, Array, Array], Array]
    """Of (system, inputs, gradient, safe); the members are the first axis of all but the system.

    Returns H^-1 gradient, H an approximation of the Hessian. Where ``safe``, H is so large that
    the step cannot raise the function."""


class Minimum(NamedTuple):
    """Where a minimisation ended."""

    p: Float[Array, "3 vertices"]
    transforms: Float[Array, "3 3 vertices"]
    energy: Float[Array, "history"]
    """At the start and after each step; undefined beyond the last step."""
    steps: Int[Array, ""]
    converged: Bool[Array, ""]

    @staticmethod
    def unknown(start: Float[Array, "*batch 3 vertices"], settings: LbfgsSettings) -> "Minimum":
        """Return zeros of these shapes, for a start or for a batch of them."""
        *lead, _, n = start.shape
        zeros = lambda *shape: jnp.zeros((*lead, *shape), start.dtype)  # noqa: E731
        return Minimum(
            zeros(3, n),
            zeros(3, 3, n),
            zeros(settings.max_steps + 1),
            jnp.zeros(lead, jnp.int32),
            jnp.zeros(lead, bool),
        )


def has_converged(gain, energy, rounding, tolerance) -> Bool[Array, "..."]:
    """Return whether the step -H^-1 g would gain less than the tolerance, or than rounding hides.

    The gain <g, H^-1 g> is a square, so it is known far more exactly than the energy itself.
    """
    eps = jnp.finfo(energy.dtype).eps
    return gain <= tolerance * jnp.abs(energy) + 1e3 * eps * rounding


def minimize(
    function: "Function",
    system: Any,
    inputs: Any,
    start: Float[Array, "3 vertices"],
    settings: LbfgsSettings,
) -> Minimum:
    """Minimise from a start. Under vmap over all but the system, run the batch as a queue."""

    def run(system, own):
        inputs, start, tolerance = own
        return _run_queue(function, system, inputs, start, settings._replace(tolerance=tolerance))

    own = inputs, start, jnp.asarray(settings.tolerance, start.dtype)
    return as_member(run, system, own)


class _Memory(NamedTuple):
    """The last steps s of each slot, and z = H^-1 y, where y is the change of the gradient.

    The large arrays are ring buffers. The inner products that the two-loop recursion needs are kept
    in order of age, oldest first, so that a direction costs two passes over each large array.
    """

    s: Float[Array, "slots steps 3 vertices"]
    z: Float[Array, "slots steps 3 vertices"]
    filled: Bool[Array, "slots steps"]
    sy: Float[Array, "slots steps steps"]
    """s_i . y_j if step i is not newer than step j, else 0."""
    yzy: Float[Array, "slots steps steps"]
    """y_i . z_j."""
    sg: Float[Array, "slots steps"]
    """s_i . g, with the gradient g at the position of the slot."""
    zg: Float[Array, "slots steps"]
    """z_i . g."""


class _Slots(NamedTuple):
    """The members at work: the accepted position of each, and the evaluation there.

    The slots are the first axis, because products with the memory go slot by slot. In ``at`` they
    are the last axis, because an evaluation goes vertex by vertex (ell.py).
    """

    p: Float[Array, "slots 3 vertices"]
    at: Sample
    z: Float[Array, "slots 3 vertices"]
    """H^-1 gradient."""
    back: Float[Array, "slots 3 vertices"]
    """Minus the step without memory: z, or where the last step was refused, the safe one."""
    gain: Float[Array, "slots"]
    """<gradient, z>: twice the expected gain of the step -z."""
    iteration: Int[Array, "slots"]
    """Number of evaluations so far."""
    history: Float[Array, "slots history"]
    memory: _Memory
    refused: Bool[Array, "slots"]
    """True where the last step was refused."""
    stalled: Bool[Array, "slots"]
    """True where two steps in a row were refused."""


class _Queue(NamedTuple):
    """``member`` is in each slot (beyond the last one, idle); ``following`` has no slot yet."""

    tick: Int[Array, ""]
    member: Int[Array, "slots"]
    following: Int[Array, ""]
    work: _Slots
    out: Minimum


def _run_queue(function, system, inputs, start, settings: LbfgsSettings) -> Minimum:
    count, tolerance = start.shape[0], jnp.asarray(settings.tolerance)  # one for each member
    most = max(SLOTS, VERTICES_AT_ONCE // start.shape[2]) if has_accelerator() else SLOTS
    slots = min(count, most)
    out = Minimum.unknown(start, settings)
    if not count:
        return out
    work = _empty(start[:slots], settings)
    work = _restart(work, jnp.ones(slots, bool), work.p)
    member = jnp.arange(slots, dtype=jnp.int32)

    def finish_some(queue: _Queue) -> _Queue:
        """Iterate until a member is done; store its result and start the next one."""
        member = queue.member
        pick = lambda x: x.at[member].get(mode="clip")  # noqa: E731
        own, limits = jax.tree.map(pick, inputs), settings._replace(tolerance=pick(tolerance))
        advance = partial(_advance, function, system, own, limits)
        idle = member >= count
        busy = lambda s: ~jnp.any(_done(s[1], limits) & ~idle)  # noqa: E731
        tick, work = jax.lax.while_loop(busy, lambda s: advance(*s), (queue.tick, queue.work))
        done = _done(work, limits) & ~idle
        ended = work.stalled | _converged(work, limits)
        transforms = jnp.moveaxis(work.at.transforms, -1, 0)
        found = Minimum(work.p, transforms, work.history, work.iteration - 1, ended)
        place, rank = jnp.where(done, member, count), jnp.cumsum(done, dtype=jnp.int32)
        store = lambda all_, new: all_.at[place].set(new, mode="drop")  # noqa: E731
        out = jax.tree.map(store, queue.out, found)
        member = jnp.where(done, queue.following + rank - 1, member)
        # A slot without a next member stays at its solution, where a step costs the least.
        work = _restart(work, done & (member < count), start.at[member].get(mode="clip"))
        return _Queue(tick, member, queue.following + rank[-1], work, out)

    begin = _Queue(jnp.zeros((), jnp.int32), member, jnp.asarray(slots, jnp.int32), work, out)
    begin = as_varying(begin, system, inputs, tolerance)
    return jax.lax.while_loop(lambda q: jnp.any(q.member < count), finish_some, begin).out


def _empty(p: Float[Array, "slots 3 vertices"], settings: LbfgsSettings) -> _Slots:
    w, m, dtype = p.shape[0], settings.history_length, p.dtype
    zeros = lambda *shape: jnp.zeros((w, *shape), dtype)  # noqa: E731
    shape, small = p.shape[1:], (m, m)
    at = Sample(*(jnp.zeros((*axes, w), dtype) for axes in ((3, *shape), shape, (), ())))
    filled = jnp.zeros((w, m), bool)
    memory = _Memory(
        zeros(m, *shape), zeros(m, *shape), filled, zeros(*small), zeros(*small), zeros(m), zeros(m)
    )
    iteration, history = jnp.zeros(w, jnp.int32), zeros(settings.max_steps + 1)
    z, no = zeros(*shape), jnp.zeros(w, bool)
    return _Slots(p, at, z, z, zeros(), iteration, history, memory, no, no)


def _restart(
    work: _Slots, which: Bool[Array, "slots"], p: Float[Array, "slots 3 vertices"]
) -> _Slots:
    """Reset some slots to the state before their first evaluation: zero step, infinite energy."""
    wide = which[:, None, None]
    return work._replace(
        p=jnp.where(wide, p, work.p),
        z=jnp.where(wide, 0.0, work.z),
        back=jnp.where(wide, 0.0, work.back),
        at=work.at._replace(energy=jnp.where(which, jnp.inf, work.at.energy)),
        iteration=jnp.where(which, 0, work.iteration),
        memory=work.memory._replace(filled=work.memory.filled & ~which[:, None]),
        refused=work.refused & ~which,
        stalled=work.stalled & ~which,
    )


def _converged(work: _Slots, settings: LbfgsSettings) -> Bool[Array, "slots"]:
    return has_converged(work.gain, work.at.energy, work.at.rounding, settings.tolerance)


def _done(work: _Slots, settings: LbfgsSettings) -> Bool[Array, "slots"]:
    running = (work.iteration <= settings.max_steps) & ~work.stalled & ~_converged(work, settings)
    return (work.iteration > 0) & ~(running & jnp.isfinite(work.at.energy))


def _advance(function: Function, system, inputs, settings: LbfgsSettings, tick, work: _Slots):
    step = _direction(work.memory, work.back, tick)
    # The first iteration evaluates the start: its step is zero and its old energy infinite. (The
    # local step is thus compiled only once.) A member that is done waits.
    step = jnp.where(_done(work, settings)[:, None, None], 0.0, step)
    p = work.p + step
    last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), (inputs, p))
    new = without_fusion(tick >= 0, work.at, partial(function.evaluate, system), *last)
    first = work.iteration == 0
    # Where even the safe step ends in NaN there is no way on: it is kept, which ends the member.
    lost = work.refused & jnp.isnan(new.energy)
    good = (new.energy <= work.at.energy + work.at.rounding) | first | lost
    keep = lambda new, old: jnp.where(jnp.broadcast_to(good, old.shape), new, old)  # noqa: E731
    right = jnp.moveaxis(jnp.stack([new.gradient - work.at.gradient, new.gradient]), -1, 0)
    g = right[:, 1]
    # After a refused step the way on is the safe step from the old place.
    back = jnp.where(good[:, None, None], g, jnp.moveaxis(work.at.gradient, -1, 0))
    back = function.metric(system, inputs, back, ~good)
    dz = back - work.z
    # All inner products of the iteration except those with the memory, as one batched product.
    left = jnp.stack([step, dz, back], axis=1)
    products = jnp.einsum("wiak,wjak->wij", left, right, precision="highest")
    # A refused step costs its evaluation and clears the memory. The safe step that follows
    # cannot raise the energy, so a second refusal in a row is due to rounding.
    stalled = work.stalled | (~good & work.refused)
    memory = _remember(work.memory, tick, good & ~first, good, step, dz, g, products)
    at = jax.tree.map(keep, new, work.at)
    slot = jnp.arange(p.shape[0], dtype=jnp.int32)
    history = work.history.at[slot, work.iteration].set(at.energy, mode="drop")
    wide = good[:, None, None]
    p, z = jnp.where(wide, p, work.p), jnp.where(wide, back, work.z)
    gain, count = keep(products[:, 2, 1], work.gain), work.iteration + 1
    return tick + 1, _Slots(p, at, z, back, gain, count, history, memory, ~good, stalled)


def _direction(memory: _Memory, z, tick) -> Float[Array, "slots 3 vertices"]:
    """Return the L-BFGS step by the two-loop recursion, on the coefficients of s and z.

    The loops, from the newest step to the oldest and back, are two triangular systems with the
    matrix s_i . y_j. Nocedal, "Updating quasi-Newton matrices with limited storage" (1980),
    doi:10.1090/S0025-5718-1980-0572855-7.
    """
    m = memory.filled.shape[1]
    both = memory.filled[:, :, None] & memory.filled[:, None]
    upper = jnp.where(both, memory.sy, jnp.eye(m, dtype=z.dtype))
    diagonal = jnp.diagonal(upper, axis1=1, axis2=2)
    solve = jax.lax.linalg.triangular_solve
    alpha = jnp.where(memory.filled, memory.sg, 0.0)[..., None]
    alpha = solve(upper, alpha, left_side=True)
    bent = jnp.sum(jnp.where(both, memory.yzy, 0.0) * jnp.swapaxes(alpha, 1, 2), axis=2)
    gamma = diagonal * alpha[..., 0] + bent - memory.zg
    gamma = jnp.where(memory.filled, gamma, 0.0)[..., None]
    gamma = solve(upper, gamma, left_side=True, transpose_a=True)
    # Go from the order of age to that of the ring buffer, where the oldest entry is filled next.
    place = (jnp.arange(m, dtype=tick.dtype) - tick) % m
    alpha, gamma = alpha[:, place, 0], gamma[:, place, 0]
    back = jnp.einsum("wm,wmak->wak", alpha, memory.z, precision="highest")
    return back - jnp.einsum("wm,wmak->wak", gamma, memory.s, precision="highest") - z


def _remember(memory: _Memory, tick, new, good, step, dz, g, products) -> _Memory:
    """Overwrite the oldest step with the new one if the curvature along it is positive.

    A slot whose step was refused forgets all steps.
    """
    m = memory.filled.shape[1]
    age = (jnp.arange(m, dtype=tick.dtype) + tick) % m
    sy, yzy = products[:, 0, 0], products[:, 1, 0]
    sg = jnp.einsum("wmak,wak->wm", memory.s, g, precision="highest")[:, age]
    zg = jnp.einsum("wmak,wak->wm", memory.z, g, precision="highest")[:, age]
    # NaN fails the comparison, so nothing that is not finite enters the memory.
    kept = after_reads(new & (sy > 1e-10 * yzy), yzy + jnp.sum(sg + zg, axis=1))
    column, square = sg - memory.sg, zg - memory.zg

    def later(matrix, row, column, corner):
        """Drop the oldest row and column, and append the newest."""
        top = jnp.concatenate([matrix[:, 1:, 1:], column[:, 1:, None]], axis=2)
        bottom = jnp.concatenate([row[:, 1:], corner[:, None]], axis=1)
        return jnp.concatenate([top, bottom[:, None]], axis=1)

    append = lambda x, last: jnp.concatenate([x[:, 1:], last[:, None]], axis=1)  # noqa: E731
    slot, where = tick % m, kept[:, None, None]
    return _Memory(
        s=memory.s.at[:, slot].set(jnp.where(where, step, memory.s[:, slot])),
        z=memory.z.at[:, slot].set(jnp.where(where, dz, memory.z[:, slot])),
        filled=append(memory.filled & good[:, None], kept),
        sy=later(memory.sy, jnp.zeros_like(column), column, sy),
        yzy=later(memory.yzy, square, square, yzy),
        sg=append(sg, products[:, 0, 1]),
        zg=append(zg, products[:, 1, 1]),
    )
