"""How smooth is a field? The smoothness that makes the poses most probable, and the intervals.

Near the fit the problem is linear: y = J t + noise, with the prior precision ``smoothness * L`` in
units of the noise. A few patterns of the field are all that poses tell of it: the leading
eigenvectors of J^T J against L (by random probing; Halko, Martinsson and Tropp 2011). In these the
probability of the poses is a closed form for every smoothness (MacKay 1992), and so is the variance
of the field (Bui-Thanh, Ghattas, Martin and Stadler 2013).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from scipy.spatial import KDTree

from jaxdeform._estimation.field_prior import Prior
from jaxdeform._linalg.waiting import wait_for

# Patterns that are looked for. Of the bar, bent once, with noise of 1e-4, 10 to 20 are above it.
_PATTERNS = 48
# Weights tried, per factor of ten.
_DENSITY = 8
# Vertices whose patches are listed together.
_PATCHES = 1024


class Patterns(NamedTuple):
    """What the poses tell of the field, pattern by pattern, the best known first."""

    vectors: Float[np.ndarray, "vertices patterns"]
    """Orthonormal in the metric of the prior."""
    strength: Float[np.ndarray, "patterns"]
    """Squares of the lengths of J times the vectors, which are orthogonal."""
    data: Float[np.ndarray, "patterns"]
    """Products of these with y = J (t - mean of t) - residual: a constant field costs nothing."""
    size: float
    """Square of y."""
    pulls: Float[np.ndarray, "draws vertices"]
    """J^T times draws of the normal distribution. The products with a change of the field are as
    large, on average, as the change of the poses that it makes."""


def find_patterns(run: Any, prior: Prior) -> Patterns:
    """Return the patterns at an evaluation: its point, residual and Jacobian."""
    vectors, effects, pulls = map(np.asarray, wait_for(_probe(run.jacobian, prior)))
    # Of the generalised eigenproblem in the space that was found.
    metric = vectors.T @ np.asarray(prior.product(jnp.asarray(vectors)))
    root = np.linalg.cholesky(metric)
    flat = np.linalg.solve(root, effects.reshape(-1, len(metric)).T).T
    _, lengths, rotation = np.linalg.svd(flat, full_matrices=False)
    vectors = np.linalg.solve(root, vectors.T).T @ rotation.T
    count = prior.n_vertices
    mean = np.mean(np.asarray(run.theta)[:count])
    seen = np.asarray(run.jacobian.mv(run.theta - mean) - run.residual, float)
    data = rotation @ (flat.T @ seen.ravel())
    size = float(np.sum(seen**2))
    return Patterns(vectors[:count], lengths**2, data, size, pulls[:, :count])


@eqx.filter_jit
def _probe(jacobian: lx.FunctionLinearOperator, prior: Prior):
    """Return a basis of the fields that poses tell of, its effects, and the pulls of the draws."""
    transposed = jacobian.transpose()
    shape = jacobian.out_structure()
    draws = jax.random.normal(jax.random.key(0), (_PATTERNS, *shape.shape), shape.dtype)
    pull = jax.vmap(transposed.mv)
    push = jax.vmap(jacobian.mv)
    orthonormal = lambda rows: jnp.linalg.qr(rows.T)[0].T  # noqa: E731
    pulls = pull(draws)
    fields = orthonormal(prior.factor.solve(pulls))
    fields = orthonormal(prior.factor.solve(pull(push(fields))))
    return fields.T, jnp.moveaxis(push(fields), 0, -1), pulls


class Evidence(NamedTuple):
    """What the poses say of the smoothness and the noise."""

    weight: float
    """Of the prior, in squares of lengths."""
    noise: float
    """Standard deviation of a coordinate (a length)."""


def most_probable(patterns: Patterns, count: int, floor: float, ends: tuple[float, float]):
    """Return the weight that makes ``count`` coordinates most probable, between two ends.

    ``floor`` is the least noise of a coordinate.
    """
    steps = int(np.ceil(_DENSITY * np.log10(ends[1] / ends[0]))) + 1
    tried = np.geomspace(*ends, steps)
    weight = min(tried, key=lambda weight: _cost(patterns, count, floor, weight))
    return with_noise(patterns, count, floor, float(weight))


def with_noise(patterns: Patterns, count: int, floor: float, weight: float) -> Evidence:
    """Return a weight with the noise under which it makes the poses most probable."""
    explained = np.sum(patterns.data**2 / (patterns.strength + weight))
    left = max(patterns.size - float(explained), count * floor**2)
    return Evidence(weight, float(np.sqrt(left / count)))


def _cost(patterns: Patterns, count: int, floor: float, weight: float) -> float:
    """Return -2 log of the probability of the poses, under the noise that makes it largest."""
    noise = with_noise(patterns, count, floor, weight).noise
    return 2.0 * count * np.log(noise) + np.sum(np.log1p(patterns.strength / weight))


def deviations(
    patterns: Patterns, prior_variances: Float[np.ndarray, "vertices"], found: Evidence
) -> Float[np.ndarray, "vertices"]:
    """Return the standard deviation of log rigidity at each vertex, given the poses."""
    known = patterns.strength / (patterns.strength + found.weight)
    variance = prior_variances - patterns.vectors**2 @ known
    return found.noise * np.sqrt(np.maximum(variance, 0.0) / found.weight)


def patch_deviations(
    patterns: Patterns, points: Float[np.ndarray, "vertices 3"], radius: float, noise: float
) -> Float[np.ndarray, "vertices"]:
    """Return how far poses alone tell the log rigidity of the patch around each vertex.

    The standard deviation of one change for all vertices within the radius, with nothing else
    unknown and no prior; infinite where the poses feel nothing of it.
    """
    tree, pulls = KDTree(points), patterns.pulls.T
    effects = np.empty(pulls.shape)
    for first in range(0, len(points), _PATCHES):
        some = points[first : first + _PATCHES]
        near = KDTree(some).sparse_distance_matrix(tree, radius, output_type="ndarray")
        shape, ones = (len(some), len(points)), np.ones(len(near))
        inside = sp.csr_matrix((ones, (near["i"], near["j"])), shape=shape)
        effects[first : first + _PATCHES] = inside @ pulls
    effect = np.sqrt(np.mean(effects**2, axis=1))
    return np.divide(noise, effect, out=np.full(len(points), np.inf), where=effect > 0.0)
