"""The metric of the descent: an inverse Hessian that knows the rigidity of every cell.

The reduced energy has the Hessian ``A - K^T (dT/dC) K`` (times 2). A itself, the matrix of Eq. 4.5,
is that of infinitely stiff cells. It serves every rigidity, but soft cells follow their vertices,
and then nearly all of A cancels. With the principal moments b of the cells, and

    H(x) = A - sum over cells and axes c of K_c^T diag(1 / (b_c + x)) K_c,

the true Hessian at unstrained cells, in any rotation, lies between H(0) and H(4 lambda): the strain
energy of Eq. 4.2 resists a change of T by 0 (a rotation) to 4 lambda (a stretch along an axis). The
metric is half their sum. The true Hessian is at most twice that, so a step of this metric alone
cannot raise the quadratic model. (docs/mathematics.md has the proof.)

Like A it is one matrix (vertices, vertices) for x, y and z. Its factor is made on the host and kept
there (metric_factor.py).

docs/mathematics.md has what it gains. Where cells are stiff that is a third of the evaluations, and
its solve takes 2 to 4 times as long as that of A; so there A is used.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from jaxdeform._deformation.local_step import LocalStep
from jaxdeform._deformation.metric_factor import metric_key, metric_solve
from jaxdeform._deformation.system import System
from jaxdeform._linalg.cholesky import HostCholesky

Choice = Literal["auto", "material", "stiffness"]


class Metric(eqx.Module):
    """The factor of a metric, as a value: what it is made from, and the key of its content."""

    key: UInt32[Array, "4"]
    rigidity: Float[Array, "vertices"]


def metric_of(
    system: System, local: LocalStep, rigidity: Float[Array, "vertices"], choice: Choice = "auto"
) -> Metric | None:
    """Return the metric for the law of a local step at this rigidity; None for A.

    It is A too where factors are not on the host (on a GPU a new factor is expensive), and for laws
    that do not name their strain energy.
    """
    law = getattr(local, "strain_rigidity", None)
    if choice == "stiffness" or law is None or not isinstance(system.factor, HostCholesky):
        return None
    result = jax.ShapeDtypeStruct(system.factor.key.shape, np.uint32)
    system, rigidity = jax.lax.stop_gradient((system, law(rigidity)))
    always = jnp.asarray(choice == "material")
    return Metric(metric_key(result, always, rigidity, *_operands(system)), rigidity)


def apply_metric(
    system: System,
    metric: Metric | None,
    right: Float[Array, "3 vertices"],
    safe: Bool[Array, ""] | bool = False,
) -> Float[Array, "3 vertices"]:
    """Return H^-1 right at free vertices, 0 at others; with ``safe``, A^-1 right."""
    if metric is None:
        return system.factor.solve(right)
    columns = jnp.where(system.free[None], right, 0.0).T
    result = jax.ShapeDtypeStruct(columns.shape, columns.dtype)
    own = metric.key, jnp.asarray(safe), metric.rigidity
    return metric_solve(result, *own, *_operands(system), columns).T


def _operands(system: System) -> list[Array]:
    """Return all that a metric is made from but the rigidity."""
    return jax.tree.leaves((system.factor, system.principal_moments, system.covariance.forward))
