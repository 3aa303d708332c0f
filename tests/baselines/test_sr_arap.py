"""Smooth-rotation ARAP against loops in NumPy, the engine, libigl and CGAL."""

import equinox as eqx
import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ends
from scipy.spatial.transform import Rotation
from small_meshes import small_mesh

import jaxdeform as jd
from benchmarks import cgal, workloads

MESH = small_mesh()
HANDLES = np.arange(3)
TARGETS = MESH.vertices[HANDLES] + [[0.3, 0.2, 0.0], [0.0, -0.4, 0.5], [0.1, 0.0, -0.3]]
TIGHT = {"tolerance": 1e-24, "max_steps": 20_000}
WEIGHTS = np.random.default_rng(1).uniform(0.5, 1.5, len(MESH.edges))


def small_sr_arap(targets, alpha=0.02, **settings):
    return jd.sr_arap(MESH, HANDLES, targets, alpha, weights=WEIGHTS, **settings)


def turned(bar, bar_problem):
    return np.asarray(jd.bend(bar.vertices[bar_problem.handles], 30.0))


def couplings():
    """Return b of each edge, by the formula of the docstring."""
    corner = MESH.vertices[MESH.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    meeting = [MESH.edges[(MESH.edges == k).any(1)] for k in range(MESH.n_vertices)]
    count = np.array([len(edges) for edges in meeting])
    return [area.sum() * (1 / count[i] + 1 / count[j]) / 2 for i, j in MESH.edges]


def brute_energy(alpha, vertices, rotations):
    """Return the energy of the docstring as a loop over edges, and its second term."""
    first = second = 0.0
    alpha = np.broadcast_to(alpha, MESH.n_vertices)
    for w, b, (i, j) in zip(WEIGHTS, couplings(), MESH.edges, strict=True):
        rest, now = MESH.vertices[i] - MESH.vertices[j], vertices[i] - vertices[j]
        first += w * sum(np.sum((now - rotations[k] @ rest) ** 2) for k in (i, j))
        second += (alpha[i] + alpha[j]) / 2 * b * np.sum((rotations[i] - rotations[j]) ** 2)
    return first + second, second


def brute_step(alpha, vertices, last):
    """Return the rotations of one local step, and the vertices of the global step after it."""
    n = MESH.n_vertices
    alpha = np.broadcast_to(alpha, n)
    fit, matrix, right = np.zeros((n, 3, 3)), np.zeros((n, n)), np.zeros((n, 3))
    for w, b, (i, j) in zip(WEIGHTS, couplings(), MESH.edges, strict=True):
        pair = np.outer(vertices[i] - vertices[j], MESH.vertices[i] - MESH.vertices[j])
        for k in (i, j):
            fit[k] += w * pair + (alpha[i] + alpha[j]) / 2 * b * (last[i] + last[j])
    u, _, vt = np.linalg.svd(fit)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotations = u @ vt
    for w, (i, j) in zip(WEIGHTS, MESH.edges, strict=True):
        pull = w * (rotations[i] + rotations[j]) @ (MESH.vertices[i] - MESH.vertices[j])
        for a, c, sign in ((i, j, 1), (j, i, -1)):
            matrix[a, a] += 2 * w
            matrix[a, c] -= 2 * w
            right[a] += sign * pull
    free = np.setdiff1d(np.arange(n), HANDLES)
    moved = vertices.copy()
    known = matrix[np.ix_(free, HANDLES)] @ vertices[HANDLES]
    moved[free] = np.linalg.solve(matrix[np.ix_(free, free)], right[free] - known)
    return rotations, moved


@pytest.mark.parametrize("alpha", [0.3, np.linspace(0.0, 2.0, MESH.n_vertices)])
def test_steps_are_those_of_loops(alpha):
    start = MESH.vertices.copy()
    start[HANDLES] = TARGETS
    vertices, rotations = start, np.zeros((MESH.n_vertices, 3, 3))
    energies = []
    for _ in range(3):
        rotations, moved = brute_step(alpha, vertices, rotations)
        energies.append(brute_energy(alpha, vertices, rotations)[0])
        before, vertices = vertices, moved
    out = small_sr_arap(TARGETS, alpha, start=start, steps=2)
    np.testing.assert_allclose(out.vertices, before, atol=1e-12)
    np.testing.assert_allclose(out.transforms, rotations, atol=1e-12)
    np.testing.assert_allclose(out.energy, energies, rtol=1e-12)
    assert int(out.steps) == 2
    assert bool(out.result == jd.Result.steps_done)


@pytest.mark.slow
def test_alpha_zero_is_arap(bar, bar_problem):
    handles, targets = bar_problem.handles, turned(bar, bar_problem)
    steps = 40
    problem = jd.precompute(bar, handles, cells=jd.spokes(bar))
    rotation, alternating = jd.RotationFit(), jd.Alternating(steps=steps)
    theirs = jd.deform(problem, targets, 0.0, local=rotation, solver=alternating)
    ours = jd.sr_arap(bar, handles, targets, 0.0, steps=steps)
    for name in ("vertices", "transforms", "energy"):
        mine, other = getattr(ours, name), getattr(theirs, name)
        np.testing.assert_allclose(mine, other, atol=1e-10 * np.abs(other).max(), err_msg=name)
    end = jd.sr_arap(bar, handles, targets, 0.0)
    assert bool(end.ok)
    np.testing.assert_allclose(
        end.vertices, np.asarray(jd.arap(bar, handles, targets)), atol=1e-4 * bar.diagonal
    )
    data = igl.ARAPData()
    data.energy, data.max_iter = igl.ARAP_ENERGY_TYPE_SPOKES, 20
    igl.arap_precomputation(bar.vertices, bar.faces, 3, handles, data)
    stayed = np.asarray(igl.arap_solve(targets, data, np.array(end.vertices)))
    np.testing.assert_allclose(end.vertices, stayed, atol=1e-3 * bar.diagonal)


@pytest.mark.parametrize("alpha", [0.0, 0.02, 5.0, 1e4])
def test_no_step_raises_the_energy(bar, bar_problem, alpha):
    targets = np.asarray(jd.bend(bar.vertices[bar_problem.handles], 90.0))
    start = bar.vertices + np.random.default_rng(0).normal(scale=4.0, size=bar.vertices.shape)
    out = jd.sr_arap(bar, bar_problem.handles, targets, alpha, start=start, steps=40)
    energy = np.asarray(out.energy)
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()
    assert energy[-1] < 0.9 * energy[0]


def test_a_rigid_motion_is_followed(bar, bar_problem):
    def move(v):
        return np.asarray(jd.rotate(v, 40.0, axis=[1.0, 2.0, 3.0]) + 5.0)

    out = jd.sr_arap(bar, bar_problem.handles, move(bar.vertices[bar_problem.handles]))
    assert bool(out.ok)
    np.testing.assert_allclose(out.vertices, move(bar.vertices), atol=1e-5 * bar.diagonal)


def test_larger_alpha_makes_rotations_smoother(bar, bar_problem):
    targets, found = turned(bar, bar_problem), []
    for alpha in (0.0, 0.02, 0.2):
        out = jd.sr_arap(bar, bar_problem.handles, targets, alpha)
        i, j = bar.edges.T
        found.append(float(jnp.sum((out.transforms[i] - out.transforms[j]) ** 2)))
        assert int(out.flipped) == 0
    assert found[0] > 1.2 * found[1] > 1.2 * 1.2 * found[2]


def test_the_end_is_a_minimum_of_the_energy():
    """No small move of the free vertices, nor turn of a cell, lowers the energy of the loops."""
    alpha = 0.1
    out = small_sr_arap(TARGETS, alpha, **TIGHT)
    vertices, rotations = np.array(out.vertices), np.array(out.transforms)
    least, _ = brute_energy(alpha, vertices, rotations)
    np.testing.assert_allclose(out.energy[-1], least, rtol=1e-12)
    rng = np.random.default_rng(0)
    for _ in range(20):
        step = rng.normal(scale=1e-3, size=vertices.shape)
        step[HANDLES] = 0.0
        turn = Rotation.from_rotvec(rng.normal(scale=1e-3, size=step.shape))
        around = turn.as_matrix() @ rotations
        assert brute_energy(alpha, vertices + step, around)[0] > least


def seen_along_a_way(s):
    """Return a number from each of vertices, transforms and energy, as targets move by s."""
    rng = np.random.default_rng(0)
    way, probe = rng.normal(size=TARGETS.shape), rng.normal(size=MESH.vertices.shape)
    turn = rng.normal(size=(MESH.n_vertices, 3, 3))
    out = small_sr_arap(TARGETS + s * way, 0.1, **TIGHT)
    return jnp.stack(
        [jnp.sum(out.vertices * probe), jnp.sum(out.transforms * turn), out.energy[-1]]
    )


def slope_of(function, h=1e-3):
    return (8 * (function(h) - function(-h)) - function(2 * h) + function(-2 * h)) / (12 * h)


@pytest.mark.slow
def test_gradients_are_those_of_the_minimum():
    def total(s):
        return jnp.sum(seen_along_a_way(s))

    slope = slope_of(jax.jit(total))
    np.testing.assert_allclose(jax.jit(jax.grad(total))(0.0), slope, rtol=1e-7)


@pytest.mark.slow
def test_forward_mode_and_second_derivatives():
    forward = jax.jit(jax.jacfwd(seen_along_a_way))
    np.testing.assert_allclose(forward(0.0), slope_of(jax.jit(seen_along_a_way)), rtol=1e-7)
    second = jax.jit(jax.jacfwd(jax.jacrev(seen_along_a_way)))(0.0)
    np.testing.assert_allclose(second, slope_of(forward), rtol=1e-6)


@pytest.mark.slow
def test_second_derivatives_through_a_scan():
    """JAX drops custom rules in such a scan."""

    def squares(s):
        body = lambda total, k: (total + jnp.sum(seen_along_a_way(k * s) ** 2), None)  # noqa: E731
        return jax.lax.scan(body, 0.0, jnp.asarray([1.0]))[0]

    slope = jax.grad(squares)
    second = jax.jit(jax.grad(slope))(0.0)
    np.testing.assert_allclose(second, slope_of(jax.jit(slope)), rtol=1e-6)


@pytest.mark.slow
def test_derivatives_of_steps_are_those_of_the_steps():
    way = np.random.default_rng(0).normal(size=TARGETS.shape)

    def far(s):
        return jnp.sum(small_sr_arap(TARGETS + s * way, 0.1, steps=3).vertices ** 2)

    h = 1e-5
    slope = (far(h) - far(-h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(far)(0.0), slope, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(far, (0.0,), (1.0,))[1], slope, rtol=1e-7)


def test_a_batch_is_its_members(bar, bar_problem):
    many = jnp.stack([jd.bend(bar.vertices[bar_problem.handles], d) for d in (5.0, 40.0)])
    batch = jax.jit(jax.vmap(lambda targets: jd.sr_arap(bar, bar_problem.handles, targets)))(many)
    assert batch.steps.shape == (2,)
    assert batch.steps[0] != batch.steps[1]
    for k, targets in enumerate(many):
        alone = jd.sr_arap(bar, bar_problem.handles, targets)
        np.testing.assert_allclose(batch.vertices[k], alone.vertices, atol=1e-9 * bar.diagonal)
        assert int(batch.steps[k]) == int(alone.steps)


def test_what_happened_is_said():
    short = small_sr_arap(TARGETS, max_steps=2)
    assert bool(short.result == jd.Result.step_limit)
    assert int(short.steps) == 2
    with pytest.raises(eqx.EquinoxRuntimeError, match="Stopped at the step limit"):
        small_sr_arap(TARGETS, max_steps=2, throw=True)
    with pytest.raises(jax.errors.JaxRuntimeError, match="Stopped at the step limit"):
        jax.jit(lambda x: small_sr_arap(x, max_steps=2, throw=True).vertices)(TARGETS)
    bad = jax.jit(lambda targets: small_sr_arap(targets))(TARGETS * np.nan)
    assert bool(bad.result == jd.Result.bad_input)


def test_misuse_is_named():
    with pytest.raises(jd.InputError, match="alpha is -1"):
        small_sr_arap(TARGETS, -1.0)
    with pytest.raises(jd.InputError, match=r"alpha is -2.0 at vertex 3"):
        small_sr_arap(TARGETS, np.where(np.arange(MESH.n_vertices) == 3, -2.0, 1.0))
    with pytest.raises(jd.InputError, match="steps is 0"):
        small_sr_arap(TARGETS, steps=0)


def test_alpha_at_some_vertices_holds_the_rotations_together_there(bar, bar_problem):
    """In the upper half of a bent bar; and a number is the same as that number everywhere."""
    handles, targets = bar_problem.handles, turned(bar, bar_problem)
    upper = bar.vertices[:, 1] > 75
    out = jd.sr_arap(bar, handles, targets, np.where(upper, 1.0, 0.0), steps=300)
    i, j = bar.edges.T
    apart = np.linalg.norm(out.transforms[i] - out.transforms[j], axis=(1, 2))
    both, none = upper[i] & upper[j], ~upper[i] & ~upper[j]
    assert apart[both].mean() < 0.5 * apart[none].mean()
    one, many = (small_sr_arap(TARGETS, x) for x in (0.3, np.full(MESH.n_vertices, 0.3)))
    np.testing.assert_array_equal(one.vertices, many.vertices)


# ---------------------------------------------------------------- CGAL


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 0.02])
def test_cgal_ends_there(bar, alpha):
    """The few vertices of the bar with another number of neighbours lie within the handles."""
    if cgal.program() is None:
        pytest.skip("no compiler, or no headers of CGAL and Eigen")
    handles = ends(bar, 0.1)
    targets = np.asarray(jd.bend(bar.vertices[handles], 30.0))
    ours = jd.sr_arap(bar, handles, targets, alpha, tolerance=1e-13, max_steps=5000)
    assert bool(ours.ok)
    with cgal.Cgal(bar, handles, targets, alpha) as peer:
        peer.deform(3000)
        theirs = peer.vertices()
    np.testing.assert_allclose(ours.vertices, theirs, atol=1e-5 * bar.diagonal)
    problem = jd.precompute(bar, handles, cells=jd.spokes(bar))
    energy = [jd.energy(problem, v, ours.transforms, 0.0) for v in (ours.vertices, theirs)]
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-5)


def weights_of_cgal(mesh: jd.Mesh) -> np.ndarray:
    """Return cotangent weights in which each obtuse angle counts as 0, not each negative sum."""
    edge = {tuple(ends): k for k, ends in enumerate(mesh.edges.tolist())}
    out = np.zeros(len(mesh.edges))
    for face in mesh.faces.tolist():
        for k in range(3):
            corner, a, b = (face[(k + step) % 3] for step in range(3))
            u, v = (mesh.vertices[end] - mesh.vertices[corner] for end in (a, b))
            cotangent = u @ v / np.linalg.norm(np.cross(u, v))
            out[edge[min(a, b), max(a, b)]] += 0.5 * max(cotangent, 0.0)
    return out


@pytest.mark.slow
def test_cgal_ends_there_on_the_cactus():
    """With alpha, vertices of other valences make it another energy: 8e-5 of the diagonal at 0.02,
    after 50,000 steps.
    """
    if cgal.program() is None:
        pytest.skip("no compiler, or no headers of CGAL and Eigen")
    load = workloads.cactus()
    mesh, handles = load.mesh, np.asarray(load.handles)
    rest = mesh.vertices[handles]
    targets = rest + 0.3 * (np.asarray(load.targets) - rest)
    weights = weights_of_cgal(mesh)
    ours = jd.sr_arap(mesh, handles, targets, 0.0, weights=weights, tolerance=1e-13)
    assert bool(ours.ok)
    with cgal.Cgal(mesh, handles, targets, 0.0) as peer:
        peer.deform(3000)
        theirs = peer.vertices()
    np.testing.assert_allclose(ours.vertices, theirs, atol=1e-5 * mesh.diagonal)
    problem = jd.precompute(mesh, handles, cells=jd.spokes(mesh, weights=weights))
    energy = [jd.energy(problem, v, ours.transforms, 0.0) for v in (ours.vertices, theirs)]
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-5)
