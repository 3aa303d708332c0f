"""The maps of Eq. 4.4 as functions of the rest shape and the edge weights, for derivatives.

The engine multiplies with matrices made once from the rest shape (covariance.py). Here the same
products are written edge by edge, from rest positions and weights that JAX can differentiate. They
are evaluated at the rest shape of the problem only, and only for a derivative: their values are
known. The principal axes of the cells stay as they are; they are a choice of coordinates.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._deformation.system import System
from jaxdeform._errors import InputError
from jaxdeform._mesh.cells import Cells
from jaxdeform._mesh.laplacian import cotangent_weights, opposite_edges


class Graph(eqx.Module):
    """What is connected to what. Made on the host from the cells, for one mesh."""

    edges: Int[Array, "2 edges"]
    cell: Int[Array, "members"]
    """The cells and the edges in them: one entry for each edge in each cell."""
    member: Int[Array, "members"]
    overlap: Float[Array, "edges"]
    """d_e of Eq. 4.5."""
    faces: Int[Array, "3 faces"]
    opposite: Int[Array, "3 faces"]
    """The edge opposite to each corner."""
    weights: Float[Array, "edges"]
    """The problem's own edge weights."""
    follows: Bool[Array, "edges"]
    """True where the weight is the cotangent weight, and so a function of the rest shape."""


def graph_of(cells: Cells, dtype: np.dtype) -> Graph:
    """Return the graph of cells."""
    mesh = cells.mesh
    count = np.diff(cells.membership.indptr)
    index = lambda x: jnp.asarray(np.ascontiguousarray(x), jnp.int32)  # noqa: E731
    return Graph(
        edges=index(mesh.edges.T),
        cell=index(np.repeat(np.arange(cells.n_vertices), count)),
        member=index(cells.membership.indices),
        overlap=jnp.asarray(cells.overlap, dtype),
        faces=index(mesh.solid_faces.T),
        opposite=index(opposite_edges(mesh)),
        weights=jnp.asarray(cells.weights, dtype),
        follows=jnp.asarray(cells.weights == cotangent_weights(mesh)),
    )


class Geometry(NamedTuple):
    """The rest shape and the edge weights, as numbers with derivatives."""

    rest: Float[Array, "3 vertices"]
    weights: Float[Array, "edges"]
    graph: Graph


def geometry_of(
    graph: Graph, rest: Float[Array, "3 vertices"], weights: Float[Array, "edges"], given: bool
) -> Geometry:
    """Return the geometry; weights that are not ``given`` follow the rest shape where they can."""
    if not given:
        cotangents = _cotangents(rest, graph)
        moved = cotangents - jax.lax.stop_gradient(cotangents)
        weights = weights + jnp.where(graph.follows, moved, 0.0)
    return Geometry(rest, weights, graph)


def _cotangents(rest: Float[Array, "3 vertices"], graph: Graph) -> Float[Array, "edges"]:
    """Return the cotangent weight of each edge, face by face (thesis Sec. 2.4)."""
    corner = [rest[:, k] for k in graph.faces]
    out = jnp.zeros(graph.overlap.shape, rest.dtype)
    for k in range(3):
        u, v = (corner[(k + step) % 3] - corner[k] for step in (1, 2))
        sine = jnp.sum(jnp.cross(u, v, axis=0) ** 2, axis=0)
        flat = sine == 0.0
        cotangent = jnp.sum(u * v, axis=0) / jnp.sqrt(jnp.where(flat, 1.0, sine))
        out = out.at[graph.opposite[k]].add(0.5 * jnp.where(flat, 0.0, cotangent))
    return out


class GeometryMaps(NamedTuple):
    """K, its transpose and A at a geometry: stands in for a `System` in an evaluation."""

    system: System
    geometry: Geometry

    @property
    def covariance(self) -> "_EdgeCovariance":
        """K and K^T."""
        return _EdgeCovariance(self.system, self.geometry)

    @property
    def stiffness(self) -> "_EdgeStiffness":
        """A."""
        return _EdgeStiffness(self.system, self.geometry)

    def moment_change(self) -> Float[Array, "3 3 vertices"]:
        """Return B in the cells' principal axes minus itself: 0, with two derivatives of B."""
        graph = self.geometry.graph
        edge = _difference(self.geometry.rest, graph)
        outer = self.geometry.weights[None, None] * edge[:, None] * edge[None]
        b = _into_cells(outer, graph, self.system.principal_moments.shape[1])
        axes = self.system.principal_axes
        b = jnp.einsum("iak,ijk,jbk->abk", axes, b, axes, precision="highest")
        return _differentiable(b - jax.lax.stop_gradient(b), 2)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _differentiable(x: Float[Array, "3 3 vertices"], times: int) -> Float[Array, "3 3 vertices"]:
    """Return x, which may be differentiated so many times (the evaluation is right that far)."""
    return x


@_differentiable.defjvp
def _differentiable_jvp(times, primals, tangents):
    if not times:
        raise InputError("rest and edge_weights have first and second derivatives only")
    return _differentiable(primals[0], times - 1), tangents[0]


class _EdgeCovariance(NamedTuple):
    system: System
    geometry: Geometry

    def __call__(self, positions: Float[Array, "3 v"], batch: int) -> Float[Array, "3 3 v"]:
        graph = self.geometry.graph
        edge = self.geometry.weights[None] * _difference(self.geometry.rest, graph)
        outer = edge[:, None] * _difference(positions, graph)[None]
        world = _into_cells(outer, graph, positions.shape[1] // batch)
        return jnp.einsum("iak,ijk->ajk", self.system.principal_axes, world, precision="highest")

    def transpose(self, transforms: Float[Array, "3 3 v"], batch: int) -> Float[Array, "3 v"]:
        del batch
        graph = self.geometry.graph
        axes = self.system.principal_axes
        world = jnp.einsum("jak,iak->ijk", transforms, axes, precision="highest")
        summed = jnp.zeros((3, 3, graph.overlap.shape[0]), world.dtype)
        summed = summed.at[..., graph.member].add(world[..., graph.cell])
        edge = self.geometry.weights[None] * _difference(self.geometry.rest, graph)
        return _to_ends(jnp.sum(edge[:, None] * summed, axis=0), graph, transforms.shape[2])


class _EdgeStiffness(NamedTuple):
    system: System
    geometry: Geometry

    def apply(self, positions: Float[Array, "3 v"], batch: int) -> Float[Array, "3 v"]:
        del batch
        graph = self.geometry.graph
        pull = (graph.overlap * self.geometry.weights)[None] * _difference(positions, graph)
        return _to_ends(pull, graph, positions.shape[1]) + self.system.soft[None] * positions


def _difference(x: Float[Array, "3 vertices"], graph: Graph) -> Float[Array, "3 edges"]:
    return x[:, graph.edges[0]] - x[:, graph.edges[1]]


def _into_cells(x: Float[Array, "3 3 edges"], graph: Graph, count: int) -> Float[Array, "3 3 v"]:
    return jnp.zeros((3, 3, count), x.dtype).at[..., graph.cell].add(x[..., graph.member])


def _to_ends(x: Float[Array, "3 edges"], graph: Graph, count: int) -> Float[Array, "3 v"]:
    out = jnp.zeros((3, count), x.dtype)
    return out.at[:, graph.edges[0]].add(x).at[:, graph.edges[1]].add(-x)
