"""The local step: the transformation of each cell, given the deformed vertices (Sec. 4.1.1).

Every solver here minimises, for each cell on its own (Eq. 4.2, in the cell's principal axes, where
B is diagonal; covariance.py),

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
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from jaxdeform._checks import check_count, check_tolerance
from jaxdeform._deformation.cell_energy import cell_energies, cell_energy, cell_sizes
from jaxdeform._deformation.cell_newton import block_newton, exact_newton, gradient_tolerance
from jaxdeform._deformation.material_derivative import material_with_derivative
from jaxdeform._linalg.batching import as_member
from jaxdeform._linalg.rotations import (
    polar_rotation,
    polar_rotation_of_grid,
    rotation_with_derivative,
)
from jaxdeform._linalg.small_matrices import (
    Matrices,
    Scalars,
    Vectors,
    as_grid,
    from_grid,
    product,
)
from jaxdeform._linalg.subset import on_few


@runtime_checkable
class LocalStep(Protocol):
    """What ``deform(..., local=)`` takes: how the transformation of each cell is found.

    All arrays have the cells on their last axis and are in the cell's principal axes, where B is
    diagonal. So a cell at rest has a rotation for T, not I, and a law must be isotropic: a function
    of the principal stretches. A local step is a setting: it must be hashable (a frozen dataclass
    is). See docs/derivatives.md for a complete example of one's own.
    """

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return T for C, the principal moments b and lambda.

        **Arguments**: c (3, 3, cells), (rest axis, deformed axis, cell); b (3, cells); rigidity
        (cells,). **Returns** T (3, 3, cells), (deformed axis, rest axis, cell).
        """
        ...

    def with_implicit_derivative(
        self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars
    ) -> Matrices:
        """Return t, known to be ``minimize(c, b, rigidity)``, with the derivatives of that."""
        ...

    def energy(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Scalars:
        """Return phi(t) of each cell, (cells,): what ``minimize`` minimises.

        It holds the terms ``tr(T B T^T) - 2 tr(T C)`` of every cell, and the law's own.
        """
        ...


def solve_local_step(local: LocalStep, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
    """Run a local step. Its iterations are not differentiated; its solution is."""
    t = _minimize(local, *map(jax.lax.stop_gradient, (c, b, rigidity)))
    return local.with_implicit_derivative(t, c, b, rigidity)


def _minimize(local: LocalStep, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
    """Run ``local.minimize``. Under vmap a batch becomes one longer list of cells.

    Cells do not know of each other. Under the general rule every member of a batch would run
    whatever any member needs, such as the exact steps of a few cells: 64 bars took 4 times as long
    per bar as one bar alone.
    """

    def minimize(_, own):
        members, cells = own[0].shape[0], own[0].shape[-1]
        flat = [jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], cells * members) for x in own]
        return jnp.moveaxis(local.minimize(*flat).reshape(3, 3, cells, members), -1, 0)

    return as_member(minimize, (), (c, b, rigidity))


class _Material:
    """Solvers of Eq. 4.2 share the derivative of its solution."""

    max_steps: int

    def __post_init__(self) -> None:
        """Check the setting."""
        check_count(f"max_steps of {type(self).__name__}", self.max_steps)

    def with_implicit_derivative(
        self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars
    ) -> Matrices:
        """Return t with the derivatives of the minimiser (implicit function theorem)."""
        return material_with_derivative(t, c, b, rigidity)

    def energy(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Scalars:
        """Return Eq. 4.2 of each cell."""
        return cell_energies(t, c, b, rigidity)

    def strain_rigidity(self, rigidity: Scalars) -> Scalars:
        """Return the lambda of the strain energy: lambda itself."""
        return rigidity


@dataclass(frozen=True)
class Newton(_Material):
    """Damped Newton on the exact gradient (Eq. 4.3) and Hessian; never raises the energy.

    First quasi-Newton steps with the block diagonal of the Hessian, which in principal axes is
    nearly all of it (three scalars and three 2x2 blocks). Then, on the few cells that this does not
    solve, exact 9x9 steps.

    **Fields**

    - max_steps: bound on the exact steps of a cell; two are usual.
    """

    max_steps: int = 60

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the minimisers T (3, 3, cells)."""
        rotation = polar_rotation_of_grid(as_grid(c))
        m = product(as_grid(c), rotation)
        m = [[m[min(i, j)][max(i, j)] for j in range(3)] for i in range(3)]  # C R = U S U^T
        # Squares of these numbers leave the range of float32 for meshes 1e10 long.
        size = cell_sizes(b, rigidity)
        m = [[v / size for v in row] for row in m]
        b, rigidity = b / size[None], rigidity / size
        data = m, list(b), rigidity, gradient_tolerance(m, rigidity)
        x, unsolved = block_newton(*data)
        few = max(64, unsolved.shape[0] // 64)
        x = on_few(partial(exact_newton, self.max_steps), unsolved, few, x, *data)
        return from_grid(product(rotation, x))


@dataclass(frozen=True)
class LBFGS(_Material):
    """jaxopt's L-BFGS, one cell at a time under vmap: the reference solver.

    With the backtracking line search, which is six times faster here than jaxopt's default one.

    Near a minimum energies differ by rounding alone, so a line search that compares them fails.
    jaxopt takes the step all the same, and learns a curvature from rounding errors: one cell in
    3,000 ran off to 1e100 and became NaN. So here the line search allows for rounding, steps
    without positive curvature are not remembered, and a step whose line search fails is refused.
    The cell goes on without memory; if that fails too, it is done.

    **Fields**

    - tolerance: stop at this gradient norm, relative to the cell's size (no less than 16 eps).
    - max_steps: bound on the steps of a cell.
    """

    tolerance: float = 1e-10
    max_steps: int = 200

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        check_tolerance("tolerance of LBFGS", self.tolerance)

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the minimisers T (3, 3, cells)."""
        c, b, lam = _scaled(c, b, rigidity)
        solve = jax.vmap(self._minimize_cell, in_axes=-1, out_axes=-1)
        return solve(polar_rotation(c), c, b, lam)

    def _minimize_cell(self, start, c, b, lam):
        import jaxopt  # slow to import, and only the reference needs it

        solver = jaxopt.LBFGS(
            cell_energy,
            linesearch="backtracking",
            maxls=30,  # down to 0.8^29 = 0.0015, less than one over the curvature
            implicit_diff=False,
        )
        # Of the energy alone: a step of 1 that is too short for Wolfe's condition is good here.
        search: Any = solver.linesearch_solver
        search.condition, search.tol = "armijo", _energy_rounding(c, b, lam)
        tolerance = max(self.tolerance, 16.0 * float(jnp.finfo(c.dtype).eps))

        def advance(state):
            step, t, last, _ = state
            after, new = solver.update(t, last, c, b, lam)
            newest = last.iter_num % solver.history_size
            curved = new.rho_history[newest] > 0
            new = new._replace(
                rho_history=jnp.where(curved, new.rho_history, new.rho_history.at[newest].set(0.0)),
                gamma=jnp.where(curved, new.gamma, last.gamma),
            )
            good = ~new.failed_linesearch & jnp.isfinite(new.error)
            had_memory = jnp.any(last.rho_history != 0)
            without_memory = last._replace(
                rho_history=jnp.zeros_like(last.rho_history),
                gamma=jnp.ones_like(last.gamma),
                stepsize=jnp.ones_like(last.stepsize),
            )
            last = jax.tree.map(partial(jnp.where, good), new, without_memory)
            done = jnp.where(good, new.error <= tolerance, ~had_memory)
            return step + 1, jnp.where(good, after, t), last, done

        def unsolved(state):
            step, _, _, done = state
            return ~done & (step < self.max_steps)

        state = (0, start, solver.init_state(start, c, b, lam), jnp.asarray(False))
        return jax.lax.while_loop(unsolved, advance, state)[1]


@dataclass(frozen=True)
class GradientDescent(_Material):
    """The thesis's own solver: gradient descent on Eq. 4.3.

    The step is one over a bound on the curvature along the way. The bound holds up to stretches of
    4; a step that raises the energy is refused and halved.

    **Fields**

    - max_steps: number of steps of each cell.
    """

    max_steps: int = 500

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the minimisers T (3, 3, cells)."""
        c, b, lam = _scaled(c, b, rigidity)
        start = polar_rotation(c)
        # phi(T) <= phi(R) bounds |T|; the Hessian of phi is below 4 lambda (3 |T|^2) + 2 b there.
        size = jnp.sqrt(jnp.sum(c * c, axis=(0, 1)))
        bound = 1.0 + size / jnp.maximum(lam + jnp.min(b, axis=0), 1e-6)
        rate = 1.0 / (12.0 * lam * jnp.minimum(bound, 4.0) ** 2 + 2.0 * jnp.max(b, axis=0) + 1e-12)

        def one_cell(start, c, b, lam, rate):
            value_and_grad = jax.value_and_grad(cell_energy)
            rounding = _energy_rounding(c, b, lam)

            def step(_, state):
                t, energy, slope, rate = state
                after = t - rate * slope
                new_energy, new_slope = value_and_grad(after, c, b, lam)
                good = new_energy <= energy + rounding
                new = after, new_energy, new_slope, rate
                return jax.tree.map(partial(jnp.where, good), new, (t, energy, slope, 0.5 * rate))

            begin = (start, *value_and_grad(start, c, b, lam), rate)
            return jax.lax.fori_loop(0, self.max_steps, step, begin)[0]

        return jax.vmap(one_cell, in_axes=-1, out_axes=-1)(start, c, b, lam, rate)


@dataclass(frozen=True)
class RotationFit:
    """The closest proper rotation (ARAP's local step, Sorkine and Alexa 2007); lambda is unused."""

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return the rotations R (3, 3, cells) that maximise tr(R C)."""
        del b, rigidity
        return polar_rotation(c)

    def with_implicit_derivative(
        self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars
    ) -> Matrices:
        """Return t with the derivatives of the polar rotation."""
        del b, rigidity
        return rotation_with_derivative(t, c)

    def energy(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Scalars:
        """Return Eq. 4.2 of each cell; a rotation has no strain."""
        return cell_energies(t, c, b, jnp.zeros_like(rigidity))


@dataclass(frozen=True)
class AffineFit:
    """The best linear map, with no resistance to strain (Eq. 4.6): the limit lambda -> 0.

    In directions in which the cell has no extent (the normal of a flat one) any map fits; there
    it is the rotation of `RotationFit`.
    """

    def minimize(self, c: Matrices, b: Vectors, rigidity: Scalars) -> Matrices:
        """Return T (3, 3, cells) with ``T B = C^T``."""
        del rigidity
        floor = 1e3 * jnp.finfo(c.dtype).eps * jnp.max(jnp.abs(b), axis=0, keepdims=True)
        floor = jnp.maximum(floor, jnp.finfo(c.dtype).tiny)
        rotation = polar_rotation(c)
        pull = (b + floor)[None]
        return (jnp.swapaxes(c, 0, 1) + floor[None] * rotation) / pull

    def with_implicit_derivative(
        self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars
    ) -> Matrices:
        """Return t with the derivatives of the linear fit, those of lambda = 0."""
        return material_with_derivative(t, c, b, jnp.zeros_like(rigidity))

    def energy(self, t: Matrices, c: Matrices, b: Vectors, rigidity: Scalars) -> Scalars:
        """Return Eq. 4.2 of each cell without resistance to strain."""
        return cell_energies(t, c, b, jnp.zeros_like(rigidity))

    def strain_rigidity(self, rigidity: Scalars) -> Scalars:
        """Return the lambda of the strain energy: 0."""
        return jnp.zeros_like(rigidity)


def _scaled(c: Matrices, b: Vectors, rigidity: Scalars) -> tuple[Matrices, Vectors, Scalars]:
    """Divide each cell's problem by its size, so that one tolerance fits all."""
    size = cell_sizes(b, rigidity)
    return c / size[None, None], b / size[None], rigidity / size


def _energy_rounding(c, b, lam):
    """How far the energies of one cell may differ by rounding alone."""
    return 8.0 * jnp.finfo(c.dtype).eps * (lam + jnp.sum(jnp.abs(b)) + jnp.sum(jnp.abs(c)))
