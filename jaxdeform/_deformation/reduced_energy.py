"""The reduced energy E(p') = min over T of E(p', T), its gradient, and the normal term of Eq. 4.7.

By the envelope theorem the gradient is that of E at the minimising T: ``2 (A p' - K^T T(p'))``.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdeform._deformation.geometry import Geometry, GeometryMaps
from jaxdeform._deformation.local_step import LocalStep, solve_local_step
from jaxdeform._deformation.system import System
from jaxdeform._linalg.ell import split_batch
from jaxdeform._linalg.lbfgs import Sample
from jaxdeform._linalg.xla import total


class Inputs(NamedTuple):
    """What ``deform`` is differentiable in, spread over all vertices."""

    targets: Float[Array, "3 *vertices"]
    """Target positions at handles, hard and soft; rest positions elsewhere."""
    rigidity: Float[Array, "*vertices"]
    soft: Float[Array, "*vertices"]
    """Weights of the soft handles; by default those of the system, which its factor holds."""
    geometry: Geometry | None = None
    """The rest shape and the edge weights, where derivatives to them are asked for."""


@dataclass(frozen=True)
class ReducedEnergy:
    """The function that is minimised. A setting, not data: all arrays are arguments."""

    local: LocalStep
    normals: bool = False

    def evaluate(
        self,
        system: System,
        inputs: Inputs,
        p: Float[Array, "3 v"],
        transforms: Float[Array, "3 3 v"] | None = None,
        batch: int | None = None,
    ) -> Sample:
        """Evaluate at p; with transforms, which must be those at p, the local step is not run.

        With a batch, the last axis of p and of the inputs is that of vertices and batch
        (linalg/ell.py), and there is one energy for each member.
        """
        size = batch or 1
        moments, free, soft = (
            jnp.repeat(x, size, axis=-1)
            for x in (system.principal_moments, system.free, system.soft)
        )
        empty = jnp.all(moments == 0.0, axis=0)
        rigidity = jnp.where(empty, 1.0, _felt(inputs.rigidity, moments))
        inputs = inputs._replace(rigidity=rigidity)
        at = None if inputs.geometry is None else GeometryMaps(system, inputs.geometry)
        maps = at or system
        c, moments = _at_rest(empty, maps.covariance(p, size), moments)
        if self.normals:
            t, cells = self._fit_with_normals(system, inputs, p, c, moments, transforms)
        elif at is None:
            t = self._fit(transforms, c, moments, inputs.rigidity)
            cells = self.local.energy(t, c, moments, inputs.rigidity)
        else:
            # B enters a law as T B only, so its change acts like one of C. The change is 0 in
            # value, so T is right to one order more each time: twice for second derivatives.
            assert transforms is not None  # a geometry is given for derivatives only
            change, t = at.moment_change(), transforms
            for _ in range(2):
                push = jnp.einsum("jik,lik->jlk", change, t)
                t = self._fit(transforms, c - push, moments, inputs.rigidity)
            cells = self.local.energy(t, c, moments, inputs.rigidity)
            cells += jnp.einsum("ijk,jlk,ilk->k", t, change, t)
        # The factor holds the system's own weights of soft handles. Other weights enter here only.
        stiff = maps.stiffness.apply(p, size) + (inputs.soft - soft)[None] * p
        pull = maps.covariance.transpose(t, size) + inputs.soft[None] * inputs.targets
        scale = total(p * stiff, batch)
        # tr(p^T A p) holds w |p|^2 of the soft handles; completed to w |p - target|^2.
        springs = inputs.soft[None] * inputs.targets * (inputs.targets - 2.0 * p)
        energy = scale + total(springs, batch) + total(jnp.where(empty, 0.0, cells), batch)
        gradient = jnp.where(free[None], stiff - pull, 0.0)
        # The energy is a small difference of terms as large as scale, hence its rounding error.
        rounding = 20.0 * jnp.finfo(p.dtype).eps * jnp.abs(scale)
        return Sample(t, gradient, energy, rounding)

    def evaluate_batch(
        self, system: System, inputs: Inputs, p: Float[Array, "3 vertices batch"]
    ) -> Sample:
        """Evaluate a batch side by side; all arrays, also those of inputs, have it last."""
        batch = p.shape[-1]
        flat = jax.tree.map(lambda x: x.reshape(*x.shape[:-2], -1), (inputs, p))
        at = self.evaluate(system, *flat, batch=batch)
        transforms, gradient = (split_batch(x, batch) for x in (at.transforms, at.gradient))
        return at._replace(transforms=transforms, gradient=gradient)

    def _fit(self, transforms, c, moments, rigidity) -> Float[Array, "3 3 v"]:
        if transforms is None:
            return solve_local_step(self.local, c, moments, rigidity)
        return self.local.with_implicit_derivative(transforms, c, moments, rigidity)

    def _fit_with_normals(self, system: System, inputs: Inputs, p, c, moments, transforms):
        """Add one edge of weight 1 from n to n', the normal of the current vertices (Eq. 4.7).

        The edge changes B, so here the cells have other principal axes.
        """
        einsum = partial(jnp.einsum, precision="highest")
        rest_normal = vertex_normals(system.rest, system)
        normal = vertex_normals(p, system)
        axes = system.principal_axes
        b = einsum("iak,ak,jak->kij", axes, moments, axes)
        b = b + einsum("ik,jk->kij", rest_normal, rest_normal)
        moments, new_axes = jnp.linalg.eigh(b)
        new_axes = new_axes * jnp.sign(jnp.linalg.det(new_axes))[:, None, None]
        moments, new_axes = moments.T, jnp.moveaxis(new_axes, 0, -1)
        rotation = einsum("iak,ibk->abk", axes, new_axes)  # from the problem's axes to these
        c = einsum("abk,ack->bck", rotation, c)
        c = c + einsum("ibk,ik,ck->bck", new_axes, rest_normal, normal)
        if transforms is not None:
            transforms = einsum("cak,abk->cbk", transforms, rotation)
        t = self._fit(transforms, c, moments, inputs.rigidity)
        has_normal = jnp.sum(normal * normal, axis=0)
        cells = self.local.energy(t, c, moments, inputs.rigidity) + has_normal
        return einsum("cbk,abk->cak", t, rotation), cells


def _felt(rigidity: Float[Array, "v"], moments: Float[Array, "3 v"]) -> Float[Array, "v"]:
    """Return the rigidity, but no more than rounding lets a cell feel.

    The strain is known to eps, so its energy to lambda eps^2, which must stay below what B weighs.
    A cell of lambda = B / (100 eps) is rigid to 100 eps. Without the bound a float32 sheet of
    rigidity 1e12 was 15 % of its length off, and 'Converged'.
    """
    most = jnp.max(jnp.abs(moments), axis=0) / (100.0 * jnp.finfo(moments.dtype).eps)
    return jnp.minimum(rigidity, most)


def _at_rest(
    empty: Bool[Array, "v"], c: Float[Array, "3 3 v"], moments: Float[Array, "3 v"]
) -> tuple[Float[Array, "3 3 v"], Float[Array, "3 v"]]:
    """Return C and b with empty cells (buckets.py) as if they were at rest, so that T = I.

    A law may divide by b.
    """
    one = jnp.eye(3, dtype=c.dtype)[..., None]
    return jnp.where(empty[None, None], one, c), jnp.where(empty[None], 1.0, moments)


def vertex_normals(
    positions: Float[Array, "3 vertices"], system: System
) -> Float[Array, "3 vertices"]:
    """Return area-weighted unit normals; 0 where a vertex has no face."""
    faces, sides = system.faces, system.sides
    a, b, c = (positions[:, faces[:, k]] for k in range(3))
    face_normal = jnp.cross(b - a, c - a, axis=0)
    normal = jnp.zeros_like(positions)
    for k in range(3):
        seen = face_normal if sides is None else face_normal * sides[None, :, k]
        normal = normal.at[:, faces[:, k]].add(seen)
    square = jnp.sum(normal**2, axis=0, keepdims=True)
    return normal / jnp.sqrt(jnp.where(square > 0, square, 1.0))
