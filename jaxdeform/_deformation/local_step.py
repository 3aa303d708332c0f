"""The local step: the transformation of each cell, given the deformed vertices (Sec. 4.1.1).

Every solver here minimises, for each cell on its own (Eq. 4.2, in the cell's principal frame,
where B is diagonal; energy.py),

    phi(T) = lambda |T^T T - I|^2 + tr(T B T^T) - 2 tr(T C).

The problem has several minima. All solvers start from the proper polar rotation R of C^T
(``Newton`` one cheap step beyond it), so T is a function of p' alone and p'(lambda) is smooth:
warm-starting T from the last iteration makes that curve noisy (4e-4) and wrong at large lambda;
starting from the identity sticks at a bend of 90 degrees; starting from the affine fit gives
inverted cells.

``Newton`` is the default because it is the fastest that reaches the minimum. It is measured
against the alternatives in docs/benchmarks.md.
"""

from dataclasses import dataclass
from functools import cache, partial
from typing import Protocol

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from jaxdeform._deformation.cell_energy import cell_energy, half_hessian
from jaxdeform._deformation.cell_newton import block_newton, exact_newton, gradient_tolerance
from jaxdeform._linalg.rotations import attach_rotation, polar_rotation, polar_rotation_of_grid
from jaxdeform._linalg.small_matrices import (
    Matrices,
    Scalars,
    Vectors,
    as_grid,
    from_grid,
    ldl_solve,
    minus_identity,
    product,
    transpose,
)
from jaxdeform._linalg.subset import on_few


class LocalStep(Protocol):
    """What ``deform(..., local=)`` takes: one of the five solvers of this file."""

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return T (deformed axis, rest axis, cell) for C, diagonal B and lambda."""
        ...

    def attach(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return t, known to be ``minimize(c, b, rigidity)``, with the derivatives of that."""
        ...


def fit(local: LocalStep, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
    """Run a local step; its iterations are not differentiated, its solution is."""
    t = _over_lanes(local)(*map(jax.lax.stop_gradient, (c, b, rigidity)))
    return local.attach(t, c, b, rigidity)


@cache
def _over_lanes(local: LocalStep):
    """Return ``local.minimize`` with a vmap of its own: the lanes' cells become one list of cells.

    Cells do not know of each other, so lanes are only more of them. Under the general rule every
    lane would run whatever any lane needs, such as the exact steps of a few cells: 64 bars took
    4 times as long a lane as one bar alone.
    """
    minimize = custom_vmap(local.minimize)

    @minimize.def_vmap
    def rule(lanes, batched, *data):
        n = data[0].shape[-1]
        spread = lambda x, is_: x if is_ else jnp.broadcast_to(x, (lanes, *x.shape))  # noqa: E731
        flat = [
            jnp.moveaxis(spread(x, is_), 0, -1).reshape(*x.shape[is_:-1], n * lanes)
            for x, is_ in zip(data, batched, strict=True)
        ]
        return jnp.moveaxis(minimize(*flat).reshape(3, 3, n, lanes), -1, 0), True

    return minimize


class _Material:
    """Solvers of Eq. 4.2 share the derivative of its solution."""

    def attach(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return t with the derivatives of the minimiser (implicit function theorem)."""
        return _attach_material(t, c, b, rigidity)


@dataclass(frozen=True)
class Newton(_Material):
    """Damped Newton on the exact gradient (Eq. 4.3) and Hessian; never raises the energy.

    First quasi-Newton steps with the block diagonal of the Hessian, which in the principal frame is
    nearly all of it (three scalars and three 2x2 blocks); then, on the few cells that this does not
    solve, exact 9x9 steps.
    """

    max_steps: int = 60
    """Bound on the exact steps of a cell; two are usual."""

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the minimisers T (3, 3, n)."""
        rotation = polar_rotation_of_grid(as_grid(c))
        m = product(as_grid(c), rotation)
        m = [[m[min(i, j)][max(i, j)] for j in range(3)] for i in range(3)]  # C R = U S U^T
        data = m, list(b), rigidity, gradient_tolerance(m, rigidity)
        x, hard = block_newton(*data)
        few = max(64, hard.shape[0] // 64)
        x = on_few(partial(exact_newton, self.max_steps), hard, few, x, *data)
        return from_grid(product(rotation, x))


@dataclass(frozen=True)
class LBFGS(_Material):
    """jaxopt's L-BFGS, one cell at a time under vmap: the reference solver.

    With the backtracking line search, which is six times faster here than jaxopt's default one.
    """

    tol: float = 1e-10
    """Stop at this gradient norm, relative to the cell's size."""
    max_steps: int = 200

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the minimisers T (3, 3, n)."""
        import jaxopt  # slow to import, and only the reference needs it

        solver = jaxopt.LBFGS(
            cell_energy,
            tol=self.tol,
            maxiter=self.max_steps,
            linesearch="backtracking",
            maxls=8,
            implicit_diff=False,
        )

        def one_cell(start, c, b, lam):
            return solver.run(start, c, b, lam).params

        c, b, lam = _scaled(c, b, rigidity)
        return jax.vmap(one_cell, in_axes=-1, out_axes=-1)(polar_rotation(c), c, b, lam)


@dataclass(frozen=True)
class GradientDescent(_Material):
    """The thesis's own solver: gradient descent on Eq. 4.3, here with a safe fixed step.

    The step is one over a bound on the curvature along the way, so that the energy cannot rise.
    """

    max_steps: int = 500

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the minimisers T (3, 3, n)."""
        c, b, lam = _scaled(c, b, rigidity)
        start = polar_rotation(c)
        # phi(T) <= phi(R) bounds |T|; the Hessian of phi is below 4 lambda (3 |T|^2) + 2 b there.
        size = jnp.sqrt(jnp.sum(c * c, axis=(0, 1)))
        bound = 1.0 + size / jnp.maximum(lam + jnp.min(b, axis=0), 1e-6)
        rate = 1.0 / (12.0 * lam * jnp.minimum(bound, 4.0) ** 2 + 2.0 * jnp.max(b, axis=0) + 1e-12)

        def one_cell(start, c, b, lam, rate):
            grad = jax.grad(cell_energy)
            step = lambda _, t: t - rate * grad(t, c, b, lam)  # noqa: E731
            return jax.lax.fori_loop(0, self.max_steps, step, start)

        return jax.vmap(one_cell, in_axes=-1, out_axes=-1)(start, c, b, lam, rate)


@dataclass(frozen=True)
class RotationFit:
    """The closest proper rotation (ARAP's local step, Sorkine and Alexa 2007); lambda is unused."""

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the rotations R (3, 3, n) that maximise tr(R C)."""
        del b, rigidity
        return polar_rotation(c)

    def attach(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return t with the derivatives of the polar rotation."""
        del b, rigidity
        return attach_rotation(t, c)


@dataclass(frozen=True)
class AffineFit:
    """The best linear map, with no resistance to strain (Eq. 4.6): the limit lambda -> 0.

    In directions in which the cell has no extent (the normal of a flat one) any map fits; there
    it is the rotation of :class:`RotationFit`.
    """

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return T (3, 3, n) with ``T B = C^T``."""
        del rigidity
        floor = 1e3 * jnp.finfo(c.dtype).eps * jnp.max(jnp.abs(b), axis=0, keepdims=True)
        floor = jnp.maximum(floor, jnp.finfo(c.dtype).tiny)
        rotation = polar_rotation(c)
        pull = (b + floor)[None]
        return (jnp.swapaxes(c, 0, 1) + floor[None] * rotation) / pull

    def attach(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return t with the derivatives of the linear fit, those of lambda = 0."""
        return _attach_material(t, c, b, jnp.zeros_like(rigidity))


@jax.custom_jvp
def _attach_material(t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
    del c, b, rigidity
    return t


@_attach_material.defjvp
def _attach_material_jvp(primals, tangents):
    """Differentiate the condition grad phi(T) = 0 instead of the iterations.

    ``H dT = dC^T - T dB - 2 (T T^T T - T) dlambda`` with H half the Hessian. A prototype that
    differentiated the iterations took 40 s to compile.
    """
    t, c, b, rigidity = primals
    _, dc, db, dlam = tangents
    tg = as_grid(t)
    gram = product(transpose(tg), tg)
    excess = product(tg, minus_identity(gram))
    right = [
        [dc[j, i] - tg[i][j] * db[j] - 2.0 * excess[i][j] * dlam for j in range(3)]
        for i in range(3)
    ]
    hessian = half_hessian(tg, list(b), rigidity)
    scale = rigidity + jnp.max(jnp.abs(b), axis=0)
    floor = jnp.finfo(c.dtype).eps * scale + jnp.finfo(c.dtype).tiny
    solution = ldl_solve(hessian, [v for row in right for v in row], floor)
    return t, from_grid([[solution[3 * i + j] for j in range(3)] for i in range(3)])


def _scaled(c: Matrices, b: Vectors, rigidity: Scalars) -> tuple[Matrices, Vectors, Scalars]:
    """Divide each cell's problem by its size, so that one tolerance fits all."""
    size = rigidity + jnp.max(jnp.abs(b), axis=0)
    size = jnp.where(size > 0, size, 1.0)
    return c / size[None, None], b / size[None], rigidity / size
