"""The reduced energy E(p') = min over T of E(p', T), and its gradient."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdeform._deformation.local_step import LocalStep, fit
from jaxdeform._deformation.problem import System
from jaxdeform._linalg.lbfgs import Sample
from jaxdeform.energy import by_lane, local_energy, total


class Held(NamedTuple):
    """The inputs that may have derivatives."""

    targets: Float[Array, "3 n"]
    """Target positions at handles, hard and soft; rest positions elsewhere."""
    rigidity: Float[Array, "n"]
    soft: Float[Array, "n"]
    """Weights of the soft handles; those of the system, which its factor holds, if not given."""


def evaluate(
    system: System,
    held: Held,
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


def evaluate_lanes(evaluate, system: System, held: Held, p: Float[Array, "3 n lanes"]) -> Sample:
    """Evaluate lanes side by side: all arrays, also those of held, have the lanes last."""
    lanes = p.shape[-1]
    flat = jax.tree.map(lambda x: x.reshape(*x.shape[:-2], -1), (held, p))
    at = evaluate(system, *flat, lanes=lanes)
    t, g = by_lane(at.transforms, lanes), by_lane(at.gradient, lanes)
    return at._replace(transforms=t, gradient=g)


def _fit_with_normals(system: System, held: Held, local: LocalStep, p, c, known):
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
