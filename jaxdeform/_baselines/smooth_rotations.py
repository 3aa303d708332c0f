"""The iteration of smooth-rotation ARAP, and the derivative of where it ends.

The energy is Eq. 3.3 with a second term, in which the rotations of neighbours pull at each other:

    E(p', R) = sum_i sum_{j in N(i)} w_ij |e'_ij - R_i e_ij|^2
               + sum_{edges ij} (alpha_i + alpha_j) / 2 b_ij |R_i - R_j|_F^2.

The local step fits all rotations at once, to the positions and to the rotations of the last
iteration. Taken alone that can raise the energy: two neighbours may exchange their rotations for
ever. So a cell counts its own last rotation too, as much as all its neighbours together. The
matrix of the coupling is then positive semidefinite, so the quadratic term in R lies above its
tangent, and no step raises the energy. The stationary points are the same, because ``|R_i|^2`` is
constant.

Rotations are in the principal axes of their cells (covariance.py).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float

from jaxdeform._deformation.cell_energy import cell_energies
from jaxdeform._deformation.descent import Descent, Iterate
from jaxdeform._deformation.local_step import RotationFit, solve_local_step
from jaxdeform._deformation.system import System
from jaxdeform._linalg.buckets import enlarge, fill_up
from jaxdeform._linalg.conjugate_gradients import conjugate_gradients
from jaxdeform._linalg.ell import EllMatrix
from jaxdeform._linalg.known_value import with_derivative_of
from jaxdeform._linalg.lbfgs import has_converged
from jaxdeform._linalg.newton import STEP_TOLERANCE, HessianSolver, Step, to_minimum
from jaxdeform._linalg.rotations import rotation_matrices
from jaxdeform._linalg.varying import as_varying
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.polygons import triangle_area_vectors
from jaxdeform._result import Result

# Of the linear system of the derivative: the residual that ends it, and the most steps.
_TOLERANCE, _MAX_STEPS = 1e-10, 2000


class SmoothEnergy(NamedTuple):
    """The function that is minimised, as arrays."""

    system: System
    coupling: EllMatrix
    """a_ij = (alpha_i + alpha_j) / 2 b_ij, with its row sums on the diagonal."""
    row_sum: Float[Array, "vertices"]

    @staticmethod
    def build(
        system: System, mesh: Mesh, alpha: Float[np.ndarray, "vertices"], dtype: np.dtype
    ) -> "SmoothEnergy":
        """Return the energy with ``b_ij = area (1 / n_i + 1 / n_j) / 2``.

        area is that of the mesh, n_i the number of neighbours of vertex i. The unit of b is that
        of covariances, length squared.
        """
        n, (i, j) = mesh.n_vertices, mesh.edges.T
        area = np.linalg.norm(triangle_area_vectors(mesh.vertices, mesh.faces), axis=1).sum()
        neighbours = np.bincount(mesh.edges.ravel(), minlength=n)
        b = 0.5 * area * (1.0 / neighbours[i] + 1.0 / neighbours[j])
        upper = sp.coo_matrix((0.5 * (alpha[i] + alpha[j]) * b, (i, j)), (n, n))
        both = upper + upper.T
        row_sum = np.asarray(both.sum(axis=1)).ravel()
        size = system.rest.shape[-1]
        coupling = EllMatrix.build([[enlarge(both + sp.diags(row_sum), size)]], dtype)
        sums = jax.device_put(fill_up(row_sum, size).astype(dtype))
        return SmoothEnergy(system, coupling, sums)

    def pull(self, t: Float[Array, "3 3 v"]) -> Float[Array, "3 3 v"]:
        """Return ``sum_j a_ij (R_j + R_i)``: a symmetric and semidefinite map of R."""
        world = self.coupling.apply(self.system.out_of_axes(t))
        return self.system.into_axes(world)

    def value(
        self, p: Float[Array, "3 v"], t: Float[Array, "3 3 v"], pull: Float[Array, "3 3 v"]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the energy, given ``pull(t)``, and the size of its rounding error."""
        system = self.system
        c, none = system.covariance(p), jnp.zeros_like(self.row_sum)
        cells = jnp.sum(cell_energies(t, c, system.principal_moments, none))
        stretch = jnp.sum(p * system.stiffness.apply(p))
        # |R_i - R_j|^2 = |R_i|^2 + |R_j|^2 - 2 <R_i, R_j>; every edge has two ends.
        twice = 2.0 * jnp.sum(self.row_sum[None, None] * t * t)
        rounding = 20.0 * jnp.finfo(p.dtype).eps * (stretch + twice)
        return stretch + cells + twice - jnp.sum(t * pull), rounding


def _advance(
    energy: SmoothEnergy,
    state: Iterate,
    is_last: Bool[Array, ""],
    tolerance: Float[Array, ""] | None,
) -> Iterate:
    """Fit the rotations, and move the vertices unless this is the end."""
    system, p, last = energy.system, state.p, state.transforms
    pulled = energy.pull(last)
    c = system.covariance(p)
    moments, none = system.principal_moments, jnp.zeros_like(p[0])
    t = solve_local_step(RotationFit(), c + jnp.swapaxes(pulled, 0, 1), moments, none)
    turned = energy.pull(t - last)
    value, rounding = energy.value(p, t, pulled + turned)
    gradient = system.stiffness.apply(p) - system.covariance.transpose(t)
    gradient = jnp.where(system.free[None], gradient, 0.0)
    move = system.factor.solve(gradient)
    # As in Alternating: the last finite p stays, and only the cells at fault are NaN.
    done = is_last | jnp.isnan(value)
    if tolerance is not None:
        # What this step gains, as squares, which rounding leaves exact: where R maximises
        # <R, M>, and so M = R S with S symmetric, 2 <R - R_last, M> = <R - R_last, (R - R_last) S>.
        change = t - last
        size = jnp.einsum("aik,ajk->ijk", t, jnp.swapaxes(c, 0, 1) + pulled, precision="highest")
        by_turning = jnp.einsum("aik,ijk->ajk", change, size, precision="highest") + turned
        gain = jnp.sum(gradient * move) + jnp.sum(change * by_turning)
        done |= has_converged(gain, value, rounding, tolerance)
        done |= value <= rounding  # a rigid motion, of energy 0
    p = jnp.where(done, p, p - move)
    return Iterate(p, t, value, done, state.steps + jnp.where(done, 0, 1))


def unrolled(energy: SmoothEnergy, start: Float[Array, "3 vertices"], steps: int) -> Descent:
    """Iterate a number of times, as a scan that both modes of differentiation go through."""

    @jax.checkpoint
    def advance(state, index):
        return _advance(energy, state, index == steps, None)

    def body(state, index):
        state = advance(state, index)
        return state, state.energy

    indices = jnp.arange(steps + 1, dtype=jnp.int32)
    end, history = jax.lax.scan(body, Iterate.before(start), indices)
    return Descent(end.p, end.transforms, history, end.steps, Result.steps_done)


def to_convergence(
    energy: SmoothEnergy, start: Float[Array, "3 vertices"], tolerance: Float[Array, ""], most: int
) -> Descent:
    """Iterate until a step gains less than the tolerance."""

    def body(carry):
        index, state, history = carry
        state = _advance(energy, state, index == most, tolerance)
        return index + 1, state, history.at[index].set(state.energy)

    history = jnp.zeros(most + 1, start.dtype)
    begin = jnp.asarray(0, jnp.int32), Iterate.before(start), history
    going = lambda carry: ~carry[1].done  # noqa: E731
    _, end, history = jax.lax.while_loop(going, body, as_varying(begin))
    result = Result.where(end.steps < most, Result.converged, Result.step_limit)
    return Descent(end.p, end.transforms, history, end.steps, result)


def with_derivative_of_minimum(
    energy: SmoothEnergy,
    targets: Float[Array, "3 vertices"],
    p: Float[Array, "3 vertices"],
    t: Float[Array, "3 3 vertices"],
) -> tuple[Float[Array, "3 vertices"], Float[Array, "3 3 vertices"]]:
    """Return p and T, known to be the minimum for these targets, with the derivatives of that.

    By the implicit function theorem on the gradient to positions and to small turns w, with
    ``T(w) = T exp([w]x)``. Its Hessian is symmetric, so one conjugate gradient method serves
    forward and reverse mode. As in `Implicit`, derivatives are taken at the minimum next to p and
    T, and are NaN where it is not found or the linear system not solved.
    """

    @jax.custom_jvp
    def minimum(energy, targets, p, t):
        del energy, targets
        return p, t

    @minimum.defjvp
    def minimum_jvp(primals, tangents):
        energy, targets, *_ = primals
        known = minimum(*primals)  # so that this rule has derivatives too
        at, there = jax.lax.stop_gradient(((energy, targets), known))
        (p, t), found = _to_minimum(*at, *there)
        zero = _at_rest(p)
        solver = HessianSolver(_preconditioner(energy, p, t), found, _TOLERANCE, _MAX_STEPS)

        def newton(targets, p, t):
            slope = _slope(energy, targets, p, t)(zero, targets)
            step = solver.solve(_hessian(energy, targets, p, t), -slope)
            moved = jnp.where(energy.system.free[None], p + step[0], targets)
            return moved, _turned(t, step[1])

        # A Newton step of size 0, whose derivatives need no rule.
        p, t = with_derivative_of(newton, (p, t), targets, p, t)
        slope = _slope(energy, targets, p, t)
        _, right = jax.jvp(lambda targets: slope(zero, targets), (targets,), (tangents[1],))
        move = solver.solve(_hessian(energy, targets, p, t), -right)
        moved = jnp.where(energy.system.free[None], move[0], tangents[1])
        _, turned = jax.jvp(lambda w: _turned(t, w), (zero[1],), (move[1],))
        return (p, t), (moved, turned)

    return minimum(energy, targets, p, t)


def _to_minimum(energy: SmoothEnergy, targets, p, t):
    """Return the minimum next to p and T, and whether it was found."""

    def step(state):
        p, t = state
        hessian, precondition = _hessian(energy, targets, p, t), _preconditioner(energy, p, t)
        slope = _slope(energy, targets, p, t)(_at_rest(p), targets)
        move, left = conjugate_gradients(hessian, precondition, -slope, STEP_TOLERANCE, _MAX_STEPS)
        moved = p + move[0], _turned(t, move[1])
        # The slope is half the gradient, and half the product is gained.
        return Step(moved, left, -jnp.sum(slope * move), *energy.value(p, t, energy.pull(t)))

    return to_minimum(step, (p, t))


def _at_rest(p: Float[Array, "3 v"]) -> Float[Array, "2 3 v"]:
    """Return no displacement, and no turn."""
    return jnp.zeros((2, *p.shape), p.dtype)


def _turned(t: Float[Array, "3 3 v"], w: Float[Array, "3 v"]) -> Float[Array, "3 3 v"]:
    return jnp.einsum("aik,kij->ajk", t, rotation_matrices(w.T), precision="highest")


def _slope(energy: SmoothEnergy, targets, p, t):
    """Return half the gradient of the energy as a function of (u, w) and the targets.

    The free vertices are at p + u, and the rotations are T(w).
    """
    system = energy.system

    def half_energy(x, targets):
        moved, turned = jnp.where(system.free[None], p + x[0], targets), _turned(t, x[1])
        stretch = jnp.sum(moved * system.stiffness.apply(moved))
        c = jnp.swapaxes(system.covariance(moved), 0, 1)
        return 0.5 * stretch - jnp.sum(turned * (c + 0.5 * energy.pull(turned)))

    return jax.grad(half_energy)


def _hessian(energy: SmoothEnergy, targets, p, t):
    """Return the Hessian as a function; the identity for vertices and rotations that are fixed."""
    system, slope = energy.system, _slope(energy, targets, p, t)
    _, hessian = jax.linearize(lambda x: slope(x, targets), _at_rest(p))
    point = ~(_turning_stiffness(energy, p, t) > 0)

    def multiply(x):
        return hessian(x) + jnp.stack([system.at_fixed(x[0]), jnp.where(point[None], x[1], 0.0)])

    return multiply


def _preconditioner(energy: SmoothEnergy, p, t):
    """Return A^-1 for u, and one over the size of C for w."""
    system, size = energy.system, _turning_stiffness(energy, p, t)

    def precondition(x):
        turn = x[1] / jnp.where(size > 0, size, 1.0)[None]
        return jnp.stack([system.factor.solve(x[0]) + system.at_fixed(x[0]), turn])

    return precondition


def _turning_stiffness(energy: SmoothEnergy, p, t) -> Float[Array, "v"]:
    """Return tr(T (C + pull)), as a constant: 0 where an unreferenced vertex has no rotation."""
    c = jnp.swapaxes(energy.system.covariance(p), 0, 1)
    return jax.lax.stop_gradient(jnp.sum(t * (c + energy.pull(t)), axis=(0, 1)))
