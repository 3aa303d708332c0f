"""The local step: every solver against first principles, per cell.

How well the solvers must agree follows from what they promise. Near its minimum phi is convex with
least curvature mu, so a gradient g leaves T within |g| / mu of the minimum, and two solvers within
the sum of theirs. A factor of 2 allows for mu, which is that at one of the two.
"""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, REAL
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import jaxdeform as jd
from jaxdeform._deformation.local_step import solve_local_step
from jaxdeform._linalg.rotations import polar_rotation

# Compiled once for each solver and number of cells; called plainly, every call compiles anew.
fit = jax.jit(solve_local_step, static_argnums=0)


def cells(strain, n=200, seed=0, flat=False):
    """Random cells: C = B (I + strain) R^T, so that T is near a rotation R stretched a little."""
    rng = np.random.default_rng(seed)
    b = rng.uniform(0.2, 1.0, (n, 3))
    if flat:
        b[:, 0] = 0.0
    r = Rotation.random(n, rng=rng).as_matrix()
    stretch = np.eye(3) + strain * rng.normal(size=(n, 3, 3))
    c = np.einsum("ni,nij,nkj->nik", b, stretch, r)
    lam = 10 ** rng.uniform(-3, 2, n)
    return jnp.asarray(np.moveaxis(c, 0, -1)), jnp.asarray(b.T), jnp.asarray(lam)


MATERIAL = [jd.Newton(), jd.LBFGS(), jd.GradientDescent()]
ALL = [*MATERIAL, jd.RotationFit(), jd.AffineFit()]
BOTH = [np.float64, np.float32]


def name(value):
    return getattr(value, "__name__", type(value).__name__)


def phi(t, c, b, lam):
    t = np.reshape(t, (3, 3))
    return (
        lam * np.sum((t.T @ t - np.eye(3)) ** 2)
        + np.trace(t @ np.diag(b) @ t.T)
        - 2 * np.trace(t @ c)
    )


@pytest.mark.parametrize("strain", [0.02, 0.2, 0.5])
def test_newton_finds_the_minimum_that_scipy_finds(strain):
    c, b, lam = cells(strain, n=40)
    t = np.asarray(fit(jd.Newton(), c, b, lam))
    start = np.asarray(polar_rotation(c))
    for k in range(40):
        args = (np.asarray(c[..., k]), np.asarray(b[:, k]), float(lam[k]))
        best = minimize(phi, start[..., k].ravel(), args, method="BFGS", options={"gtol": 1e-9})
        assert phi(t[..., k], *args) <= best.fun + 1e-8 * (1 + abs(best.fun))


def test_no_solver_raises_the_energy():
    c, b, lam = cells(0.8)
    start = np.asarray(polar_rotation(c))
    for local in (jd.GradientDescent(max_steps=3), jd.Newton(), jd.LBFGS()):
        t = np.asarray(fit(local, c, b, lam))
        for k in range(200):
            args = (np.asarray(c[..., k]), np.asarray(b[:, k]), float(lam[k]))
            assert phi(t[..., k], *args) <= phi(start[..., k], *args) + 1e-12


def test_polar_rotation_is_the_best_proper_rotation():
    rng = np.random.default_rng(3)
    c = rng.normal(size=(500, 3, 3))
    r = np.moveaxis(np.asarray(polar_rotation(jnp.asarray(np.moveaxis(c, 0, -1)))), -1, 0)
    u, _, vt = np.linalg.svd(c)
    sign = np.sign(np.linalg.det(u @ vt))
    want = np.einsum("nji,nj,nkj->nik", vt, np.stack([sign**0, sign**0, sign], 1), u)
    np.testing.assert_allclose(r, want, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, rtol=EXACT)
    np.testing.assert_allclose(
        r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=EXACT
    )


@pytest.mark.parametrize("scale", [0.0, 1e-150, 1.0, 1e120])
def test_degenerate_cells_give_a_proper_rotation(scale):
    """Empty, collapsed to a line, collapsed to a plane, exactly symmetric."""
    ranks = np.array([np.zeros((3, 3)), np.diag([1.0, 0, 0]), np.diag([0, 1.0, 1]), np.eye(3)])
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    c = jnp.asarray(np.moveaxis(scale * np.concatenate([ranks, ranks @ turn]), 0, -1))
    r = np.moveaxis(np.asarray(polar_rotation(c)), -1, 0)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, rtol=EXACT)
    np.testing.assert_allclose(
        r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=EXACT
    )
    if scale == 0.0:
        np.testing.assert_allclose(r, np.broadcast_to(np.eye(3), r.shape), atol=EXACT)


def test_affine_fit_recovers_the_linear_map():
    rng = np.random.default_rng(4)
    b = rng.uniform(0.5, 2.0, (50, 3))
    t = np.eye(3) + 0.3 * rng.normal(size=(50, 3, 3))
    c = np.einsum("ni,nji->nij", b, t)
    found = fit(jd.AffineFit(), jnp.asarray(np.moveaxis(c, 0, -1)), jnp.asarray(b.T), jnp.zeros(50))
    # It leans on the rotation by 2e-13 of the cell's size, for the sake of flat cells.
    np.testing.assert_allclose(np.moveaxis(np.asarray(found), -1, 0), t, atol=1e-9)


@pytest.mark.parametrize("local", [jd.Newton(), jd.LBFGS(), jd.RotationFit(), jd.AffineFit()])
def test_derivatives_by_differences(local):
    c, b, lam = cells(0.2, n=30)
    rng = np.random.default_rng(5)
    dc, dlam = jnp.asarray(rng.normal(size=c.shape)), jnp.asarray(rng.normal(size=lam.shape)) * lam
    _, tangent = jax.jvp(lambda c, lam: fit(local, c, b, lam), (c, lam), (dc, dlam))
    h = 1e-5
    upper = fit(local, c + h * dc, b, lam + h * dlam)
    lower = fit(local, c - h * dc, b, lam - h * dlam)
    difference = (upper - lower) / (2 * h)
    np.testing.assert_allclose(tangent, difference, atol=FD * float(jnp.abs(difference).max()))
    weight = jnp.asarray(rng.normal(size=c.shape))
    _, pull = jax.vjp(lambda c, lam: fit(local, c, b, lam), c, lam)
    gc, glam = pull(weight)
    both = jnp.sum(gc * dc) + jnp.sum(glam * dlam)
    np.testing.assert_allclose(both, jnp.sum(weight * tangent), rtol=1e-9)


@pytest.mark.parametrize("local", ALL, ids=name)
def test_not_a_number_stays_in_its_cell(local):
    c, b, lam = cells(0.1)
    t = fit(local, c.at[0, 0, 7].set(jnp.nan), b, lam)
    good = np.delete(np.arange(200), 7)
    np.testing.assert_allclose(t[..., good], fit(local, c, b, lam)[..., good], atol=1e-9)


# ---------------------------------------------------------------- the solvers of one minimum


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


def hard_cells(kind, dtype, n=64):
    """Return the cells of one kind that is near a limit."""
    rng = np.random.default_rng(1)
    b = np.sort(rng.uniform(0.2, 1.0, (n, 3)), axis=1)
    lam = 10 ** rng.uniform(-3, 2, n)
    strain, scale, mirror = 0.2, 1.0, np.ones(3)
    if kind == "flat":
        b[:, 0] = 0.0
    elif kind == "flat, nearly at rest":
        b[:, 0], strain, lam[:] = 0.0, 1e-9, 0.3
    elif kind == "collinear":
        b[:, :2] = 0.0
    elif kind == "point":
        b[:] = 0.0
    elif kind == "no rigidity":
        lam[:] = 0.0
    elif kind == "flat, no rigidity":
        b[:, 0] = lam[:] = 0.0
    elif kind == "rigidity 1e-12 to 1e12":
        lam = 10 ** rng.uniform(-12, 12, n)
    elif kind == "stretched":
        strain = 0.5
    elif kind == "mirrored":
        mirror[2] = -1.0
    elif kind != "plain":
        scale = float(kind)
    r = Rotation.random(n, rng=rng).as_matrix()
    stretch = (np.eye(3) + strain * rng.normal(size=(n, 3, 3))) @ np.diag(mirror)
    c = np.einsum("ni,nij,nkj->ikn", b, stretch, r)
    return [np.asarray(scale * x, dtype) for x in (c, b.T, lam)]


HARD = ["plain", "flat", "flat, nearly at rest", "collinear", "point", "no rigidity"]
HARD += ["flat, no rigidity", "rigidity 1e-12 to 1e12", "stretched", "mirrored", "1e-12", "1e12"]


@pytest.mark.parametrize("dtype", BOTH, ids=name)
@pytest.mark.parametrize("kind", HARD)
def test_the_solvers_find_the_same_minimum(kind, dtype):
    data = hard_cells(kind, dtype)
    # A mirrored cell has several minima, and the solvers may go to different ones.
    solutions = {local: fit(local, *data) for local in MATERIAL}
    check_minima(solutions, *data, unique=kind != "mirrored")
    for local in (jd.RotationFit(), jd.AffineFit()):
        assert np.isfinite(fit(local, *data)).all()


@pytest.mark.parametrize("dtype", BOTH, ids=name)
@pytest.mark.parametrize("local", ALL, ids=name)
def test_jit_scan_and_vmap_give_the_same(local, dtype):
    kinds = ["plain", "flat", "rigidity 1e-12 to 1e12"]
    data = [hard_cells(kind, dtype) for kind in kinds]
    stacked = [jnp.stack(x) for x in zip(*data, strict=True)]
    scanned = jax.jit(lambda *x: jax.lax.scan(lambda _, y: (0, fit(local, *y)), 0, x)[1])(*stacked)
    mapped = jax.jit(jax.vmap(partial(fit, local)))(*stacked)
    for k, cells_of_kind in enumerate(data):
        alone = fit(local, *cells_of_kind)
        for t in (scanned[k], mapped[k]):
            if local in MATERIAL:
                check_minima(
                    {jd.Newton(): fit(jd.Newton(), *cells_of_kind), local: t}, *cells_of_kind
                )
            else:
                np.testing.assert_allclose(t, alone, atol=1e3 * np.finfo(dtype).eps)


def test_the_reference_stays_finite_where_energies_differ_by_rounding_alone():
    """Of such cells jaxopt's own loop made one in 3,000 NaN, and only in compiled code."""
    n, rng = 20_000, np.random.default_rng(1)
    b = np.repeat([[0.0], [0.0988], [0.0991]], n, axis=1)
    r = Rotation.random(n, rng=rng).as_matrix()
    c = np.einsum("in,nij->ijn", b, r) * (1 + 3e-9 * rng.normal(size=(3, 3, n)))
    data = c + 3e-10 * rng.normal(size=c.shape), b, np.full(n, 0.3)
    check_minima({local: fit(local, *data) for local in (jd.Newton(), jd.LBFGS())}, *data)


# ---------------------------------------------------------------- the real meshes

MESHES = sorted(p.name for p in REAL.glob("*") if p.suffix in (".obj", ".off", ".ply"))
CHUNK = 8192


@pytest.fixture(scope="module")
def real_cells():
    """The cells of every public mesh, bent and shaken, with rigidities of 1e-3 to 1e3 their size.

    In chunks of one size, so that a solver is compiled once.
    """
    if not MESHES:
        pytest.skip(f"needs {REAL.parent.name}/{REAL.name} beside the project")
    rng, found = np.random.default_rng(0), []
    for file in MESHES:
        try:
            mesh = jd.load_mesh(REAL / file)
            one_each = np.unique(mesh.components[mesh.referenced], return_index=True)[1]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of negative weights
                problem = jd.precompute(mesh, np.flatnonzero(mesh.referenced)[one_each])
        except jd.InputError:
            continue  # not a manifold, for instance: refused before any cell is solved
        x = np.asarray(problem.system.rest)
        x, length = x / np.ptp(x), np.ptp(x)
        angle = 2.5 * x[1]
        bent = np.stack([x[0] * np.cos(angle) - x[2] * np.sin(angle), x[1] + 0.2 * x[0] ** 2])
        bent = np.stack([*bent, x[0] * np.sin(angle) + x[2] * np.cos(angle)])
        edge = np.sqrt(np.median(np.square(mesh.vertices[mesh.edges] @ [1, -1, 0]).sum(-1)))
        p = length * bent + 0.02 * edge * rng.normal(size=bent.shape)
        b = np.asarray(problem.system.principal_moments)
        lam = np.maximum(np.abs(b).max(axis=0), 1e-300) * 10 ** rng.uniform(-3, 3, b.shape[1])
        found.append((np.asarray(problem.system.covariance(jnp.asarray(p))), b, lam))
    data = [np.concatenate(x, axis=-1) for x in zip(*found, strict=True)]
    index = np.arange(-(-data[2].size // CHUNK) * CHUNK) % data[2].size
    return [np.stack(np.split(x[..., index], len(index) // CHUNK, axis=-1)) for x in data]


@pytest.mark.slow
@pytest.mark.parametrize("way", ["jit", "scan", "vmap"])
@pytest.mark.parametrize("dtype", BOTH, ids=name)
def test_every_cell_of_the_real_meshes(real_cells, dtype, way):
    # Scan and vmap run what jit runs: two chunks show it, and all of them take half an hour.
    data = [x[: None if way == "jit" else 2].astype(dtype) for x in real_cells]
    solutions = {}
    for local in ALL:
        if way == "jit":
            t = [fit(local, *chunk) for chunk in zip(*data, strict=True)]
        elif way == "scan":
            run = jax.jit(lambda *x: jax.lax.scan(lambda _, y: (0, fit(local, *y)), 0, x)[1])  # noqa: B023
            t = run(*data)
        else:
            t = jax.jit(jax.vmap(partial(fit, local)))(*data)
        t = np.asarray(t)
        assert np.isfinite(t).all(), local
        solutions[local] = t
    for k, chunk in enumerate(zip(*data, strict=True)):
        # Some cells have several minima: L-BFGS finds a lower one than Newton in 2 of 57,344. In
        # float32 Newton ends above its tolerance in 62 of them, nearly flat and stiff ones.
        found = {local: solutions[local][k] for local in MATERIAL}
        check_minima(found, *chunk, agreement=0.998 if dtype == np.float64 else 0.99)
