"""What the tests of the local step share: the solvers, and when they have found one minimum.

How well the solvers must agree follows from what they promise. Near its minimum phi is convex with
least curvature mu, so a gradient g leaves T within |g| / mu of the minimum, and two solvers within
the sum of theirs. A factor of 2 allows for mu, which is that at one of the two.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxdeform as jd
from jaxdeform._deformation.local_step import solve_local_step
from jaxdeform._linalg.rotations import polar_rotation

# Compiled once for each solver and number of cells; called plainly, every call compiles anew.
fit = jax.jit(solve_local_step, static_argnums=0)

MATERIAL = [jd.Newton(), jd.LBFGS(), jd.GradientDescent()]
ALL = [*MATERIAL, jd.RotationFit(), jd.AffineFit()]
BOTH = [np.float64, np.float32]


def name(value):
    return getattr(value, "__name__", type(value).__name__)


class Cells:
    """Cells in units of their own size, in double precision, cells first; the energy of T there."""

    def __init__(self, c, b, lam):
        c, b, lam = (np.asarray(x, np.float64) for x in (c, b, lam))
        size = lam + np.abs(b).max(axis=0)
        size[size == 0] = 1.0
        self.c = np.moveaxis(c / size, -1, 0)
        self.b, self.lam = (b / size).T, lam / size
        self.scale = self.lam + np.abs(self.b).sum(axis=1) + np.abs(self.c).sum(axis=(1, 2))

    def energy(self, t):
        strain = np.swapaxes(t, 1, 2) @ t - np.eye(3)
        linear = np.einsum("nij,nji->n", t, self.c)
        square = np.einsum("nij,nj->n", t**2, self.b)
        return self.lam * (strain**2).sum(axis=(1, 2)) + square - 2 * linear

    def gradient(self, t):
        """Return its norm."""
        strain = np.swapaxes(t, 1, 2) @ t - np.eye(3)
        lam, b = self.lam[:, None, None], self.b[:, None]
        slope = 4 * lam * t @ strain + 2 * t * b - 2 * np.swapaxes(self.c, 1, 2)
        return np.linalg.norm(slope, axis=(1, 2))

    def curvature(self, t):
        """Return the least eigenvalue of the Hessian, whose columns are its products."""
        strain, hessian = np.swapaxes(t, 1, 2) @ t - np.eye(3), np.zeros((len(t), 9, 9))
        lam, b = self.lam[:, None, None], self.b[:, None]
        for k in range(9):
            e = np.zeros((3, 3))
            e.flat[k] = 1.0
            turned = e @ strain + t @ (e.T @ t + np.swapaxes(t, 1, 2) @ e)
            hessian[:, :, k] = (4 * lam * turned + 2 * e * b).reshape(-1, 9)
        return np.linalg.eigvalsh(hessian)[:, 0]

    def tolerance(self, local, eps):
        """Return the gradient that a solver promises (cell_newton.py, local_step.py)."""
        if isinstance(local, jd.Newton):
            size = self.lam + np.linalg.norm(self.c, axis=(1, 2))
            return 2 * (4e-10 + 100 * eps) * size  # it measures half the gradient
        if isinstance(local, jd.LBFGS):
            return np.full(len(self.lam), max(local.tolerance, 16 * eps))
        return np.full(len(self.lam), np.inf)  # it only promises a number of steps


def check_minima(solutions, c, b, lam, *, unique=True, agreement=1.0):
    """Check solutions of the cells by the solvers of MATERIAL, {solver: T}.

    Where the minimum is unique they must agree, in this fraction of the cells.
    """
    eps = float(np.finfo(c.dtype).eps)
    problem = Cells(c, b, lam)
    solutions = {k: np.moveaxis(np.asarray(t, np.float64), -1, 0) for k, t in solutions.items()}
    start = np.moveaxis(np.asarray(polar_rotation(jnp.asarray(c)), np.float64), -1, 0)
    rounding = 10 * eps * problem.scale
    best = solutions[jd.Newton()]
    mu, least = problem.curvature(best), problem.gradient(best)
    for local, t in solutions.items():
        assert np.isfinite(t).all(), f"{local}: cells {np.flatnonzero(~np.isfinite(t).all((1, 2)))}"
        g = problem.gradient(t)
        short = g > problem.tolerance(local, eps) + rounding
        assert short.mean() <= 1 - agreement, local
        far = np.linalg.norm(t, axis=(1, 2)) ** 4  # rounding grows with the energy's terms
        rise = problem.energy(t) - problem.energy(start)
        assert (rise <= rounding * (1 + far)).all(), local
        if not unique:
            continue
        gap = np.linalg.norm(t - best, axis=(1, 2))
        excess = problem.energy(t) - problem.energy(best)
        below = excess < -least * gap - rounding * (1 + far)
        assert below.mean() <= 1 - agreement, local
        # 500 steps of descent leave some stretched, soft cells far from the minimum.
        near = g + least <= 0.02 * np.maximum(mu, 1e-2 * problem.scale)
        assert near.mean() > 0.7, local
        above = near & (excess > (g + least) * gap + rounding * (1 + far))
        assert above.mean() <= 1 - agreement, local
        # Where mu is nothing (a flat cell without rigidity) many T are best.
        sure = near & (mu > 1e-4)
        assert (sure & (gap * mu > 2 * (g + least) + rounding)).mean() <= 1 - agreement, local
