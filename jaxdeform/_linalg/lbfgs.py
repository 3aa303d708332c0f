"""Preconditioned L-BFGS on the reduced energy, for one deformation or a queue of them.

The minimiser behind :class:`QuasiNewton`. It knows of meshes only that positions are (3, n) and
that A^-1 is there to precondition with.

Lanes and slots. Under vmap the general rule for loops would run all lanes until the slowest is
done, and choose between old and new values of everything in every turn (measured on 64 bars of
which the slowest takes twice the mean: 6 times a single one's time per lane). Here the lanes are a
queue instead: a few slots iterate together, and a slot whose lane is done takes the next one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from jaxdeform.global_step import has_accelerator

# Lanes that iterate together. More would wait more for each other at the end, and outgrow the
# caches; fewer would leave the cores idle (a lane of 64 bars: 10.5, 10.3, 11.2, 13.7 and 16.1 ms
# with 8, 12, 16, 24 and 32 slots. Going on with 4 once no lanes are left takes a tenth off, and
# compiles twice as long).
SLOTS = 12
# On an accelerator, as many lanes as have this many vertices together, which fills it; their arrays
# then take about 4 GB in float64. (Reasoned, not measured: no accelerator was at hand.)
VERTICES_AT_ONCE = 1 << 22


class Settings(NamedTuple):
    """When to stop, and how much to remember; see :class:`QuasiNewton`."""

    tolerance: float
    max_steps: int
    memory: int


class Sample(NamedTuple):
    """What one evaluation at p tells, in one or in several lanes."""

    transforms: Float[Array, "3 3 n *w"]
    gradient: Float[Array, "3 n *w"]
    """Half the gradient of the reduced energy, 0 at fixed vertices: A p - K^T T."""
    energy: Float[Array, "*w"]
    rounding: Float[Array, "*w"]
    """Two energies closer than this differ by rounding alone."""


class Descent(NamedTuple):
    """Where a descent ended."""

    p: Float[Array, "3 n"]
    transforms: Float[Array, "3 3 n"]
    energy: Float[Array, "history"]
    """At the start and after each step; anything behind the last."""
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def has_converged(gain, energy, rounding, tolerance: float) -> Bool[Array, "..."]:
    """Whether a plain step is expected to gain less than the tolerance, or than can be computed.

    The gain <g, A^-1 g> is a square, so it is known far more exactly than the energy itself.
    """
    eps = jnp.finfo(energy.dtype).eps
    return gain <= tolerance * jnp.abs(energy) + 1e3 * eps * rounding


def minimize(
    evaluate: Callable[[Any, Any, Array], Sample],
    system: Any,
    held: Any,
    start: Float[Array, "3 n"],
    settings: Settings,
) -> Descent:
    """Minimise from a start; under vmap over ``held`` and ``start``, lane by lane in slots.

    ``evaluate(system, held, p)`` tells of the p of several slots, which are the last axis of all it
    takes and returns; ``system.factor.solve`` is A^-1.
    """

    @custom_vmap
    def lanes(system, held, start):
        return _run_queue(evaluate, system, held, start, settings)

    @lanes.def_vmap
    def more_lanes(size, batched, system, *own):
        if any(jax.tree.leaves(batched[0])):
            raise NotImplementedError("vmap over problems: they differ in structure; loop instead")
        spread = lambda x, is_: x if is_ else jnp.broadcast_to(x, (size, *x.shape))  # noqa: E731
        own = jax.tree.map(spread, own, tuple(batched[1:]))
        each = own[-1].shape[1]
        flat = jax.tree.map(lambda x: x.reshape(size * each, *x.shape[2:]), own)
        out = jax.tree.map(lambda x: x.reshape(size, each, *x.shape[1:]), lanes(system, *flat))
        return out, jax.tree.map(lambda _: True, out)

    one = jax.tree.map(lambda x: x[None], (held, start))
    return jax.tree.map(lambda x: x[0], lanes(system, *one))


class _Memory(NamedTuple):
    """The last steps of each slot: s (steps) and z = A^-1 y (y: change of gradient).

    The large arrays are a ring; what the two-loop recursion needs of their products is kept from
    the oldest to the newest, so that a direction costs two passes over each large array.
    """

    s: Float[Array, "w m 3 n"]
    z: Float[Array, "w m 3 n"]
    filled: Bool[Array, "w m"]
    sy: Float[Array, "w m m"]
    """s_i . y_j for i no newer than j, else 0."""
    yzy: Float[Array, "w m m"]
    sg: Float[Array, "w m"]
    """s_i . g at the slot's point."""
    zg: Float[Array, "w m"]


class _Slots(NamedTuple):
    """The lanes at work: an accepted position each, and what was evaluated there.

    The slots come first, since products with the memory are slot by slot; in ``at`` they come last,
    since an evaluation is vertex by vertex (energy.py).
    """

    p: Float[Array, "w 3 n"]
    at: Sample
    z: Float[Array, "w 3 n"]
    """A^-1 gradient: the plain step, negated."""
    gain: Float[Array, "w"]
    """<gradient, z>: twice what a plain step is expected to gain."""
    turn: Int[Array, "w"]
    """Evaluations done."""
    history: Float[Array, "w history"]
    memory: _Memory
    stalled: Bool[Array, "w"]


def _run_queue(evaluate, system, held, start, settings: Settings) -> Descent:
    count = start.shape[0]
    most = max(SLOTS, VERTICES_AT_ONCE // start.shape[2]) if has_accelerator() else SLOTS
    slots = min(count, most)
    out = Descent(
        jnp.zeros_like(start),
        jnp.zeros((count, 3, *start.shape[1:]), start.dtype),
        jnp.zeros((count, settings.max_steps + 1), start.dtype),
        jnp.zeros(count, jnp.int32),
        jnp.zeros(count, bool),
    )
    if not count:
        return out
    work = _empty(start[:slots], settings)
    work = _restart(work, jnp.ones(slots, bool), work.p)
    lane = jnp.arange(slots, dtype=jnp.int32)

    def turn_over(state):
        """Iterate until a lane is done; put it away and take the next ones."""
        tick, lane, following, work, out = state
        own = jax.tree.map(lambda x: jnp.moveaxis(x.at[lane].get(mode="clip"), 0, -1), held)
        advance = partial(_advance, evaluate, system, own, settings)
        idle = lane >= count
        tick, work = jax.lax.while_loop(
            lambda s: ~jnp.any(_done(s[1], settings) & ~idle), lambda s: advance(*s), (tick, work)
        )
        done = _done(work, settings) & ~idle
        ended = work.stalled | _converged(work, settings)
        transforms = jnp.moveaxis(work.at.transforms, -1, 0)
        found = Descent(work.p, transforms, work.history, work.turn - 1, ended)
        place = jnp.where(done, lane, count)
        out = jax.tree.map(lambda all_, new: all_.at[place].set(new, mode="drop"), out, found)
        lane = jnp.where(done, following + jnp.cumsum(done, dtype=jnp.int32) - 1, lane)
        # A slot for which no lane is left stays at its solution, where a step costs the least.
        work = _restart(work, done & (lane < count), start.at[lane].get(mode="clip"))
        return tick, lane, following + jnp.sum(done, dtype=jnp.int32), work, out

    begin = (jnp.zeros((), jnp.int32), lane, jnp.asarray(slots, jnp.int32), work, out)
    return jax.lax.while_loop(lambda s: jnp.any(s[1] < count), turn_over, begin)[-1]


def _empty(p: Float[Array, "w 3 n"], settings: Settings) -> _Slots:
    w, m, dtype = p.shape[0], settings.memory, p.dtype
    zeros = lambda *shape: jnp.zeros((w, *shape), dtype)  # noqa: E731
    shape, small = p.shape[1:], (m, m)
    at = Sample(*(jnp.zeros((*axes, w), dtype) for axes in ((3, *shape), shape, (), ())))
    filled = jnp.zeros((w, m), bool)
    memory = _Memory(
        zeros(m, *shape), zeros(m, *shape), filled, zeros(*small), zeros(*small), zeros(m), zeros(m)
    )
    turn, history = jnp.zeros(w, jnp.int32), zeros(settings.max_steps + 1)
    return _Slots(p, at, zeros(*shape), zeros(), turn, history, memory, jnp.zeros(w, bool))


def _restart(work: _Slots, which: Bool[Array, "w"], p: Float[Array, "w 3 n"]) -> _Slots:
    """Put some slots before their first evaluation: a step of zero, from infinite energy."""
    wide = which[:, None, None]
    return work._replace(
        p=jnp.where(wide, p, work.p),
        z=jnp.where(wide, 0.0, work.z),
        at=work.at._replace(energy=jnp.where(which, jnp.inf, work.at.energy)),
        turn=jnp.where(which, 0, work.turn),
        memory=work.memory._replace(filled=work.memory.filled & ~which[:, None]),
        stalled=work.stalled & ~which,
    )


def _converged(work: _Slots, settings: Settings) -> Bool[Array, "w"]:
    return has_converged(work.gain, work.at.energy, work.at.rounding, settings.tolerance)


def _done(work: _Slots, settings: Settings) -> Bool[Array, "w"]:
    running = (work.turn <= settings.max_steps) & ~work.stalled & ~_converged(work, settings)
    return (work.turn > 0) & ~(running & jnp.isfinite(work.at.energy))


def _advance(evaluate, system, held, settings: Settings, tick, work: _Slots):
    step = _direction(work.memory, work.z, tick)
    # The first turn evaluates the start: its step is zero, its old energy infinite. (So the local
    # step is compiled once.) A lane that is done waits.
    step = jnp.where(_done(work, settings)[:, None, None], 0.0, step)
    p = work.p + step
    new = _apart(tick >= 0, work.at, partial(evaluate, system), held, jnp.moveaxis(p, 0, -1))
    right = jnp.moveaxis(jnp.stack([new.gradient - work.at.gradient, new.gradient]), -1, 0)
    g = right[:, 1]
    z = system.factor.solve(g)
    dz = z - work.z
    # All inner products of a turn that are not with the memory, as one batched product.
    left = jnp.stack([step, dz, z], axis=1)
    products = jnp.einsum("wiak,wjak->wij", left, right, precision="highest")
    first = work.turn == 0
    good = (new.energy <= work.at.energy + work.at.rounding) | first
    # A refused step costs its evaluation and the memory; the plain step that follows cannot raise
    # the energy, so a second refusal in a row is rounding.
    stalled = work.stalled | (~good & ~jnp.any(work.memory.filled, axis=1))
    memory = _remember(work.memory, tick, good & ~first, good, step, dz, g, products)
    keep = lambda new, old: jnp.where(jnp.broadcast_to(good, old.shape), new, old)  # noqa: E731
    at = jax.tree.map(keep, new, work.at)
    slot = jnp.arange(p.shape[0], dtype=jnp.int32)
    history = work.history.at[slot, work.turn].set(at.energy, mode="drop")
    wide = good[:, None, None]
    p, z = jnp.where(wide, p, work.p), jnp.where(wide, z, work.z)
    gain = keep(products[:, 2, 1], work.gain)
    return tick + 1, _Slots(p, at, z, gain, work.turn + 1, history, memory, stalled)


def _apart(always: Bool[Array, ""], otherwise, function, *arguments):
    """Run a function as a computation of its own.

    Else the compiler repeats the end of it, here the sum that makes the gradient, inside every
    expression that reads it: 3 of the 7 ms of a turn of 16 bars.
    """
    return jax.lax.cond(always, function, lambda *_: otherwise, *arguments)


def _direction(memory: _Memory, z, tick) -> Float[Array, "w 3 n"]:
    """The two-loop recursion (Nocedal 1980) on the coefficients of s and z.

    From the newest step to the oldest and back: two triangular systems with the matrix s_i . y_j.
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
    # From the order of age to that of the ring, whose oldest slot is the one to fill now.
    place = (jnp.arange(m, dtype=tick.dtype) - tick) % m
    alpha, gamma = alpha[:, place, 0], gamma[:, place, 0]
    back = jnp.einsum("wm,wmak->wak", alpha, memory.z, precision="highest")
    return back - jnp.einsum("wm,wmak->wak", gamma, memory.s, precision="highest") - z


def _remember(memory: _Memory, tick, new, good, step, dz, g, products) -> _Memory:
    """Put new steps into the oldest slot, if the curvature along them is positive.

    A lane whose step was not good forgets all.
    """
    m = memory.filled.shape[1]
    age = (jnp.arange(m, dtype=tick.dtype) + tick) % m
    sy, yzy = products[:, 0, 0], products[:, 1, 0]
    sg = jnp.einsum("wmak,wak->wm", memory.s, g, precision="highest")[:, age]
    zg = jnp.einsum("wmak,wak->wm", memory.z, g, precision="highest")[:, age]
    # (NaN fails the comparison; so nothing that is not finite ever comes in.) That it reads sg and
    # zg tells the compiler that the old arrays are done with, so it writes into them, not a copy.
    kept = new & (sy > 1e-10 * yzy) & jnp.isfinite(yzy + jnp.sum(sg + zg, axis=1))
    column, square = sg - memory.sg, zg - memory.zg

    def later(matrix, row, column, corner):
        """Drop the oldest, append the newest."""
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
