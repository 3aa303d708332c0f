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
from functools import cache, partial, reduce
from typing import Protocol

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float

Matrices = Float[Array, "3 3 n"]
Vectors = Float[Array, "3 n"]
Scalars = Float[Array, "n"]
# One component of all cells at a time: plain Python lists of (n,) arrays, so that every product
# below is one contiguous, vectorised pass, and small matrices cost no transposition.
Grid = list[list[Array]]

_PAIRS = ((0, 1), (0, 2), (1, 2))

# Up to this many cells the slow ones are not worth code of their own.
SMALL = 2000


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
        rotation = _polar(_grid(c))
        m = _product(_grid(c), rotation)
        m = [[m[min(i, j)][max(i, j)] for j in range(3)] for i in range(3)]  # C R = U S U^T
        data = m, list(b), rigidity, _tolerance(m, rigidity)
        x, hard = _block_newton(*data)
        few = max(64, hard.shape[0] // 64)
        x = _on_few(partial(_exact_newton, self.max_steps), hard, few, x, *data)
        return _stack(_product(rotation, x))


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
            _cell_objective,
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
            grad = jax.grad(_cell_objective)
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
        return _attach_rotation(t, c)


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


# ---------------------------------------------------------------- the material fit's derivative


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
    tg = _grid(t)
    gram = _product(_transpose(tg), tg)
    excess = _product(tg, _minus_identity(gram))
    right = [
        [dc[j, i] - tg[i][j] * db[j] - 2.0 * excess[i][j] * dlam for j in range(3)]
        for i in range(3)
    ]
    hessian = _hessian(tg, list(b), rigidity)
    scale = rigidity + jnp.max(jnp.abs(b), axis=0)
    floor = jnp.finfo(c.dtype).eps * scale + jnp.finfo(c.dtype).tiny
    solution = _ldl_solve(hessian, [v for row in right for v in row], floor)
    return t, _stack([[solution[3 * i + j] for j in range(3)] for i in range(3)])


def _cell_objective(t, c, b, lam):
    """Eq. 4.2 for one cell, (3, 3); the form that jaxopt and the thesis's descent see."""
    strain = jnp.matmul(t.T, t, precision="highest") - jnp.eye(3, dtype=t.dtype)
    return lam * jnp.sum(strain**2) + jnp.sum(t**2 * b[None, :]) - 2.0 * jnp.sum(t * c.T)


def _scaled(c: Matrices, b: Vectors, rigidity: Scalars) -> tuple[Matrices, Vectors, Scalars]:
    """Divide each cell's problem by its size, so that one tolerance fits all."""
    size = rigidity + jnp.max(jnp.abs(b), axis=0)
    size = jnp.where(size > 0, size, 1.0)
    return c / size[None, None], b / size[None], rigidity / size


# ---------------------------------------------------------------- Newton


def _half_gradient(x: Grid, m: Grid, b: list[Array], lam: Array) -> Grid:
    gram = _product(_transpose(x), x)
    middle = [
        [
            2.0 * lam * (gram[i][j] - 1.0) + b[i] if i == j else 2.0 * lam * gram[i][j]
            for j in range(3)
        ]
        for i in range(3)
    ]
    g = _product(x, middle)
    return [[g[i][j] - m[j][i] for j in range(3)] for i in range(3)]


def _norm(g: Grid) -> Array:
    return jnp.sqrt(sum(v * v for row in g for v in row))


def _tolerance(m: Grid, lam: Array) -> Array:
    """Gradient norm at which a cell is done: 4e-10 (float64) or 1e-5 (float32) of its scale."""
    eps = jnp.finfo(lam.dtype).eps
    return (4e-10 + 100.0 * eps) * (lam + _norm(m)) + jnp.finfo(lam.dtype).tiny


def _on_few(solve, waiting: Bool[Array, "n"], size: int, x, *data):
    """Replace x by ``solve(x, *data)`` in the cells that wait, ``size`` cells at a time.

    Usually they are none, and nothing is run. All arrays have the cells last.
    """
    n = waiting.shape[0]
    if size >= n:
        # A loop, since under vmap a cond would run for all lanes, always.
        put = lambda old, new: jnp.where(waiting, new, old)  # noqa: E731

        def once(state):
            x, _ = state
            return jax.tree.map(put, x, solve(x, *data)), jnp.zeros((), bool)

        return jax.lax.while_loop(lambda state: state[1], once, (x, jnp.any(waiting)))[0]

    def advance(state):
        x, waiting = state
        (chosen,) = jnp.nonzero(waiting, size=size, fill_value=n)
        pick = lambda v: v.at[..., chosen].get(mode="clip")  # noqa: E731
        put = lambda old, new: old.at[..., chosen].set(new, mode="drop")  # noqa: E731
        x = jax.tree.map(put, x, solve(*jax.tree.map(pick, (x, *data))))
        return x, put(waiting, jnp.zeros(chosen.shape, bool))

    return jax.lax.while_loop(lambda state: jnp.any(state[1]), advance, (x, waiting))[0]


def _block_newton(
    m: Grid, b: list[Array], lam: Scalars, tolerance: Scalars
) -> tuple[Grid, Bool[Array, "n"]]:
    """Quasi-Newton with the block diagonal of the Hessian; also tell who is not done.

    Where X and B are diagonal the blocks ARE the Hessian, and they stay close: from the start
    below, half of 50,298 cells with strains of 5 % are done after three steps, seven in eight after
    four, all after eight (from X = I each takes two more). A step costs 1 ms for 51,200 cells, an
    exact one 13 ms. Once one cell in eight is left, these are gone on with by themselves (on small
    meshes it would only be more to compile). Cells that stop getting better are left to the exact
    steps.
    """
    n = lam.shape[0]
    x, data = _diagonal_start(m, b, lam), (m, b, lam, tolerance)
    few = n // 8 if n > SMALL else 0
    x, waiting = _block_steps(x, *data, leave=few)
    if few:
        again = lambda state, *data: _block_steps(state[0], *data, leave=0)  # noqa: E731
        x, waiting = _on_few(again, waiting, few, (x, waiting), *data)
    return x, waiting


def _diagonal_start(m: Grid, b: list[Array], lam: Scalars) -> Grid:
    """Solve for X as if m were diagonal (three cubics), then once for what is beside it.

    The cubics are followed by Newton from 1, the rotation, without leaving its basin.
    """
    tiny = _tiny(b, lam)

    def newton(_, diagonal):
        slope = [2.0 * lam * (3.0 * y * y - 1.0) + b[i] + tiny for i, y in enumerate(diagonal)]
        force = [2.0 * lam * (y * y - 1.0) * y + b[i] * y - m[i][i] for i, y in enumerate(diagonal)]
        # At 0.577 the slope of the cubic vanishes.
        return [jnp.maximum(diagonal[i] - force[i] / slope[i], 0.6) for i in range(3)]

    x = _identity(lam)
    # A loop, or the compiler would repeat these in each of the six entries that follow.
    for i, y in enumerate(jax.lax.fori_loop(0, 3, newton, [x[i][i] for i in range(3)])):
        x[i][i] = y
    for i, j in _PAIRS:
        both = 2.0 * lam * (x[i][i] ** 2 + x[j][j] ** 2 - 1.0)
        cross = 2.0 * lam * x[i][i] * x[j][j]
        x[i][j], x[j][i] = _pair(both + b[j], both + b[i], cross, m[j][i], m[i][j], tiny)
    return x


def _block_steps(
    x: Grid, m: Grid, b: list[Array], lam: Scalars, tolerance: Scalars, leave: int
) -> tuple[Grid, Bool[Array, "n"]]:
    """Take up to 30 steps, until all cells but ``leave`` are done or stuck; tell who is not done.

    A step is written so that nothing but X is kept: the compiler then makes one pass over the cells
    for each of its nine entries, which is a third faster than keeping the gradient too.
    """
    tiny = _tiny(b, lam)

    def advance(state):
        step, x, last, busy = state
        g = _half_gradient(x, m, b, lam)
        size = _norm(g)
        # A gradient that does not shrink means a poor model here: freeze the cell for later.
        busy = busy & (size < 0.9 * last) & (size > tolerance)
        gram, outer = _product(_transpose(x), x), _product(x, _transpose(x))

        def stiff(i: int, j: int):  # the second derivative along x_ij
            return 2.0 * lam * (outer[i][i] + gram[j][j] + x[i][j] ** 2 - 1.0) + b[j]

        move = [[g[i][j] for j in range(3)] for i in range(3)]
        for i in range(3):
            h = stiff(i, i)
            move[i][i] = g[i][i] / jnp.where(jnp.abs(h) > tiny, h, tiny)
        for i, j in _PAIRS:
            cross = 2.0 * lam * x[i][i] * x[j][j]
            pair = _pair(stiff(i, j), stiff(j, i), cross, g[i][j], g[j][i], tiny)
            move[i][j], move[j][i] = pair
        y = [[x[i][j] - move[i][j] for j in range(3)] for i in range(3)]
        # Convergence is linear, so whom this step takes there is known before: a turn less. (Should
        # it come out otherwise, the check at the end will tell.)
        arrives = 4.0 * size * size < tolerance * last
        return step + 1, _where(busy, y, x), size, busy & ~(arrives & jnp.isfinite(last))

    begin = (0, x, jnp.full_like(lam, jnp.inf), jnp.ones_like(lam, bool))
    unfinished = lambda s: (jnp.sum(s[3]) > leave) & (s[0] < 30)  # noqa: E731
    x = jax.lax.while_loop(unfinished, advance, begin)[1]
    return x, ~(_norm(_half_gradient(x, m, b, lam)) <= tolerance)


def _pair(hi, hj, cross, gi, gj, tiny) -> tuple[Array, Array]:
    """Solve ``[[hi, cross], [cross, hj]] d = (gi, gj)``, with a floor under the determinant."""
    det = hi * hj - cross * cross
    small = tiny * (jnp.abs(hi) + jnp.abs(hj) + tiny)
    det = jnp.where(jnp.abs(det) > small, det, small)
    return (hj * gi - cross * gj) / det, (hi * gj - cross * gi) / det


def _tiny(b: list[Array], lam: Scalars) -> Scalars:
    """A stiffness that is none, next to that of the cell."""
    info = jnp.finfo(lam.dtype)
    return info.eps * (lam + jnp.abs(b[0]) + jnp.abs(b[1]) + jnp.abs(b[2])) + info.tiny


def _exact_newton(max_steps: int, x: Grid, m: Grid, b: list[Array], lam, tolerance) -> Grid:
    solve = jax.vmap(partial(_newton_cell, max_steps), in_axes=-1, out_axes=-1)
    return _grid(solve(_stack(x), _stack(m), jnp.stack(b), lam, tolerance))


def _newton_cell(max_steps: int, x, m, b, lam, tolerance) -> Float[Array, "3 3"]:
    """Levenberg-damped Newton with the 9x9 Hessian; a step that raises the energy is refused.

    Should the quasi-Newton steps have ended above the energy of the rotation (they may, at extreme
    strain), the cell starts again from there, X = I.
    """
    identity = jnp.eye(3, dtype=x.dtype)
    eps = jnp.finfo(x.dtype).eps
    scale = lam + jnp.sum(jnp.abs(b)) + jnp.sum(jnp.abs(m))

    def half_gradient(x):
        cube = jnp.einsum("ij,kj,kl->il", x, x, x, precision="highest")
        return 2.0 * lam * (cube - x) + x * b[None] - m.T

    def advance(state):
        step, x, before, damping = state
        matrix = jax.jacfwd(half_gradient)(x).reshape(9, 9) + damping * jnp.eye(9, dtype=x.dtype)
        factor = jax.lax.linalg.cholesky(matrix)  # not a number unless positive definite
        move = jax.scipy.linalg.cho_solve((factor, True), half_gradient(x).reshape(9))
        move = move.reshape(3, 3)
        after = _cell_objective(x - move, m, b, lam)
        # Near the minimum two energies differ by rounding alone, hence the allowance.
        good = after <= before + 8.0 * eps * scale
        raised = jnp.maximum(4.0 * damping, 1e-3 * scale)
        lowered = jnp.where(damping > 1e-6 * scale, 0.1 * damping, 0.0)
        return (
            step + 1,
            jnp.where(good, x - move, x),
            jnp.where(good, after, before),
            jnp.where(good, lowered, raised),
        )

    def unsolved(state):
        step, x, _, _ = state
        return (jnp.linalg.norm(half_gradient(x)) > tolerance) & (step < max_steps)

    here, fresh = _cell_objective(x, m, b, lam), jnp.sum(b) - 2.0 * jnp.trace(m)
    x = jnp.where(here <= fresh, x, identity)
    state = (0, x, jnp.minimum(here, fresh), jnp.zeros_like(lam))
    return jax.lax.while_loop(unsolved, advance, state)[1]


def _hessian(x: Grid, b: list[Array], lam: Array) -> list[list[Array]]:
    """Half the Hessian of phi at X as a full 9x9 (only its lower half is read)."""
    gram, outer = _product(_transpose(x), x), _product(x, _transpose(x))
    rows: list[list[Array]] = []
    for i in range(3):
        for j in range(3):
            row = []
            for k in range(3):
                for l in range(3):  # noqa: E741
                    value = x[i][l] * x[k][j]
                    if l == j:
                        value = value + outer[i][k]
                    if i == k:
                        value = value + gram[l][j]
                    if (i, j) == (k, l):
                        row.append(2.0 * lam * (value - 1.0) + b[j])
                    else:
                        row.append(2.0 * lam * value)
            rows.append(row)
    return rows


def _ldl_solve(matrix: list[list[Array]], right: list[Array], floor: Array) -> list[Array]:
    """Solve the symmetric 9x9 systems by LDL^T, unrolled into scalars: 13 ms for 51,200 cells.

    A pivot below ``floor`` (a direction with no stiffness) is replaced by it.
    """
    size = len(right)
    lower: list[list[Array]] = [[matrix[0][0]] * size for _ in range(size)]
    diagonal: list[Array] = []
    for j in range(size):
        scaled = [lower[j][k] * diagonal[k] for k in range(j)]
        pivot = matrix[j][j] - sum(lower[j][k] * scaled[k] for k in range(j))
        diagonal.append(jnp.where(jnp.abs(pivot) > floor, pivot, floor))
        for i in range(j + 1, size):
            value = matrix[i][j] - sum(lower[i][k] * scaled[k] for k in range(j))
            lower[i][j] = value / diagonal[j]
    y = list(right)
    for i in range(size):
        y[i] = y[i] - sum(lower[i][k] * y[k] for k in range(i))
    y = [y[i] / diagonal[i] for i in range(size)]
    for i in reversed(range(size)):
        y[i] = y[i] - sum(lower[k][i] * y[k] for k in range(i + 1, size))
    return y


# ---------------------------------------------------------------- the polar rotation


def polar_rotation(c: Matrices) -> Matrices:
    """Return the proper rotations R (det +1) that maximise tr(R C), cell by cell.

    ``C = U S V^T`` gives ``R = V U^T``; where C is singular or its own reflection is closer, the
    direction of the least singular value takes the sign. In closed form but for a quartic (FOAM,
    Markley 1993), which keeps full precision on flat cells too, with the SVD where R is (nearly)
    not unique: 2.5 ms for 51,200 cells, where a Jacobi SVD by components takes 10, LAPACK's 130.
    """
    return _stack(_polar(_grid(c)))


def _polar(c: Grid) -> Grid:
    # Scaled to the order of 1, since the products square and cube the entries.
    size = reduce(jnp.maximum, [jnp.abs(v) for row in c for v in row])
    scale = jnp.where(size > 0, size, 1.0)
    c = [[v / scale for v in row] for row in c]
    rotation, certain = _markley(c)
    n = size.shape[0]
    return _on_few(_svd_rotation, ~certain, n if n <= SMALL else n // 64, rotation, c)


def _markley(c: Grid) -> tuple[Grid, Bool[Array, "n"]]:
    """Return the rotations, and where they are exact.

    The largest root of ``(x^2 - |C|^2)^2 - 4 |cof C|^2 - 8 x det C`` is x = s1 + s2 + s3, the last
    with the sign of det C. Newton comes down to it from a bound above. The error of R is that of
    the root over ``zeta = (s1 + s2) (s2 + s3) (s3 + s1)``: 1e-15 to 1e-11 where zeta > 1e-4 x^3.
    """
    a = _transpose(c)
    eps = jnp.finfo(a[0][0].dtype).eps
    cofactor = [_cross(a[1], a[2]), _cross(a[2], a[0]), _cross(a[0], a[1])]
    square = jnp.asarray(sum(_inner(row, row) for row in a))
    det = _inner(a[0], cofactor[0])
    area = sum(_inner(row, row) for row in cofactor)

    def newton(_, state):
        x, _ = state
        rise = x * x - square
        slope = 4.0 * x * rise - 8.0 * det
        move = (rise * rise - 4.0 * area - 8.0 * det * x) / jnp.where(slope > 0, slope, 1.0)
        return x - move, jnp.abs(move)

    bound = jnp.sqrt(square + 2.0 * jnp.sqrt(3.0 * area))
    # Three steps in one pass over the cells. (As a loop, or the compiler would repeat them in each
    # of the nine entries that follow.)
    thrice = lambda _, state: reduce(lambda s, k: newton(k, s), range(3), state)  # noqa: E731
    x, move = jax.lax.fori_loop(0, 2, thrice, (bound, bound))
    kappa = 0.5 * (x * x - square)
    zeta = kappa * x - det
    gram = _product(_transpose(a), a)
    cubic = _product(a, gram)
    scale = jnp.where(zeta > 0, zeta, 1.0)
    rotation = [
        [((kappa + square) * a[i][j] + x * cofactor[i][j] - cubic[i][j]) / scale for j in range(3)]
        for i in range(3)
    ]
    certain = (zeta > (1e-4 + 1e5 * eps) * x**3) & (move <= jnp.sqrt(eps) * x)
    # A cell that is a point (an unreferenced vertex) stays as it is.
    point = square == 0
    return _where(point, _identity(x), rotation), certain | point


def _svd_rotation(rotation: Grid, c: Grid) -> Grid:
    """Return the rotations by LAPACK's SVD, which settles the cells with several best ones."""
    del rotation
    u, _, vt = jnp.linalg.svd(jnp.moveaxis(_stack(c), -1, 0))
    sign = jnp.sign(jnp.linalg.det(u) * jnp.linalg.det(vt))
    last = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign], axis=-1)
    return _grid(
        jnp.moveaxis(jnp.einsum("kij,ki,kli->kjl", vt, last, u, precision="highest"), 0, -1)
    )


@jax.custom_jvp
def _attach_rotation(rotation: Matrices, c: Matrices) -> Matrices:
    del c
    return rotation


@_attach_rotation.defjvp
def _attach_rotation_jvp(primals, tangents):
    """``dR = R [w]x`` with ``(tr(M) I - M) w = axial(N - N^T)``, M = C R, N = R^T dC^T."""
    rotation, c = primals
    dc = tangents[1]
    r, rt = _grid(rotation), _transpose(_grid(rotation))
    m = _product(_grid(c), r)
    n = _product(rt, [[dc[j, i] for j in range(3)] for i in range(3)])
    trace = m[0][0] + m[1][1] + m[2][2]
    s = [
        [(trace if i == j else 0.0) - 0.5 * (m[i][j] + m[j][i]) for j in range(3)] for i in range(3)
    ]
    axial = [n[2][1] - n[1][2], n[0][2] - n[2][0], n[1][0] - n[0][1]]
    cofactor = [_cross(s[1], s[2]), _cross(s[2], s[0]), _cross(s[0], s[1])]
    det = _inner(s[0], cofactor[0])
    floor = jnp.finfo(c.dtype).eps * jnp.abs(trace) ** 3 + jnp.finfo(c.dtype).tiny
    det = jnp.where(jnp.abs(det) > floor, det, jnp.inf)  # no unique rotation: no derivative
    w = [sum(cofactor[k][i] * axial[k] for k in range(3)) / det for i in range(3)]
    zero = jnp.zeros_like(trace)
    skew = [[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]]
    return rotation, _stack(_product(r, skew))


# ---------------------------------------------------------------- 3x3 algebra by components


def _grid(matrices: Matrices) -> Grid:
    return [[matrices[i, j] for j in range(3)] for i in range(3)]


def _stack(grid: Grid) -> Matrices:
    return jnp.stack([jnp.stack(row) for row in grid])


def _transpose(x: Grid) -> Grid:
    return [[x[j][i] for j in range(3)] for i in range(3)]


def _product(x: Grid, y: Grid) -> Grid:
    return [
        [x[i][0] * y[0][j] + x[i][1] * y[1][j] + x[i][2] * y[2][j] for j in range(3)]
        for i in range(3)
    ]


def _identity(like: Array) -> Grid:
    one, zero = jnp.ones_like(like), jnp.zeros_like(like)
    return [[one if i == j else zero for j in range(3)] for i in range(3)]


def _where(condition: Array, x: Grid, y: Grid) -> Grid:
    return [[jnp.where(condition, x[i][j], y[i][j]) for j in range(3)] for i in range(3)]


def _minus_identity(x: Grid) -> Grid:
    return [[x[i][j] - 1.0 if i == j else x[i][j] for j in range(3)] for i in range(3)]


def _inner(u: list[Array], v: list[Array]) -> Array:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def _cross(u: list[Array], v: list[Array]) -> list[Array]:
    return [
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    ]
