"""The main job: invariants, peers, derivatives, and what happens to bad input."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg
from conftest import EXACT, FD, PEER, ends, real_mesh
from scipy.spatial.transform import Rotation

import jaxdeform as jd
from jaxdeform._linalg import lbfgs

TWENTY = jd.Alternating(steps=20)


def relative(a, b):
    a, b = np.asarray(a), np.asarray(b)
    return np.abs(a - b).max() / np.ptp(b, axis=0).max()


# ---------------------------------------------------------------- against libigl


def plain_arap(mesh, handles, targets, start, steps):
    """Eq. 3.3 in NumPy, float64 throughout: spokes, LAPACK's SVD, SciPy's LU."""
    n, (i, j) = mesh.n_vertices, mesh.edges.T
    w = jd.cotangent_weights(mesh)
    free = np.setdiff1d(np.arange(n), handles)
    laplacian = scipy.sparse.csgraph.laplacian(
        scipy.sparse.coo_matrix((np.r_[w, w], (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsr()
    ).tocsc()
    solve = scipy.sparse.linalg.splu(laplacian[free][:, free]).solve
    a, b, w = np.r_[i, j], np.r_[j, i], np.r_[w, w]
    rest = mesh.vertices[a] - mesh.vertices[b]
    p = start.copy()
    p[handles] = targets
    for _ in range(steps):
        c = np.zeros((n, 3, 3))
        np.add.at(c, a, w[:, None, None] * rest[:, :, None] * (p[a] - p[b])[:, None, :])
        u, _, vt = np.linalg.svd(c)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        r = np.swapaxes(u @ vt, 1, 2)
        right = np.zeros((n, 3))
        np.add.at(right, a, 0.5 * w[:, None] * np.einsum("kij,kj->ki", r[a] + r[b], rest))
        p[free] = solve(right[free] - laplacian[free][:, handles] @ targets)
    return p


@pytest.mark.parametrize(
    ("name", "peer"),
    # Thin arms multiply libigl's float32 rotations: 7e-6 after 20 steps on a cactus, where
    # float64 agrees to 1e-9 with us.
    [("bar", PEER), ("cylinder", PEER), ("cactus", 2e-5), ("cactus.off", 2e-5)],
)
def test_rotation_fit_on_spokes_is_arap(name, peer):
    mesh = real_mesh(name) if "." in name else getattr(jd.shapes, name)()
    long = int(np.argmax(np.ptp(mesh.vertices, axis=0)))
    handles = ends(mesh, along=long)
    along, toward = "xyz"[long], "xyz"[long - 1]
    targets = np.asarray(jd.bend(mesh.vertices[handles], 10.0, along=along, toward=toward))
    start = np.array(jd.laplacian_editing(mesh, handles, targets))
    problem = jd.precompute(mesh, handles, cells=jd.spokes(mesh))
    out = jd.deform(
        problem, targets, 0.0, local=jd.RotationFit(), solver=TWENTY, start=start
    ).vertices
    assert relative(out, plain_arap(mesh, handles, targets, start, 20)) < 1e-9
    data = igl.ARAPData()
    data.energy = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_SPOKES
    data.max_iter = 20
    igl.arap_precomputation(mesh.vertices, mesh.faces, 3, handles, data)
    assert relative(out, igl.arap_solve(targets, data, start.copy())) < peer


# ---------------------------------------------------------------- invariants


@pytest.mark.parametrize("solver", [TWENTY, jd.QuasiNewton()])
@pytest.mark.parametrize("rigidity", [1e-3, 0.3, 30.0, 1e3])
def test_energy_falls_at_every_step(bar_problem, bar_targets, rigidity, solver):
    out = jd.deform(bar_problem, bar_targets, rigidity, solver=solver)
    energy = np.asarray(out.energy)
    assert (np.diff(energy) <= 1e-9 * energy[0]).all()
    assert energy[-1] < energy[0]
    again = jd.energy(bar_problem, out.vertices, out.transforms, rigidity)
    np.testing.assert_allclose(energy[-1], again, rtol=1e-9)
    assert np.linalg.det(np.asarray(out.transforms)).min() > 0


def test_both_solvers_reach_the_same_shape(bar_problem, bar_targets):
    slow = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.Alternating(1500))
    fast = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.QuasiNewton(tolerance=1e-12))
    assert relative(fast.vertices, slow.vertices) < 1e-5
    assert int(fast.steps) < 150
    assert bool(fast.result.ok)


def test_a_gradient_that_vanishes_is_a_stationary_energy(bar_problem, bar_targets):
    """The reduced energy does not change to first order at the solution."""
    out = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.QuasiNewton(tolerance=1e-13))
    rng = np.random.default_rng(0)
    move = rng.normal(size=(722, 3))
    move[bar_problem.handles] = 0
    f = lambda s: jd.energy(bar_problem, out.vertices + s * move, out.transforms, 1.0)  # noqa: E731
    slope = float(jax.grad(f)(0.0))
    curvature = float(jax.hessian(f)(0.0))
    assert abs(slope) < 1e-4 * curvature


@pytest.mark.parametrize("normals", [False, True])
def test_rigid_motion_of_the_handles_moves_everything_rigidly(bar, bar_problem, normals):
    turn = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
    moved = bar.vertices @ turn.T + np.array([5.0, -300.0, 20.0])
    out = jd.deform(
        bar_problem,
        moved[bar_problem.handles],
        2.0,
        normals=normals,
        start=bar.vertices if not normals else moved,
        solver=jd.Alternating(5) if normals else jd.QuasiNewton(tolerance=1e-14),
    )
    assert relative(out.vertices, moved) < 1e-6
    np.testing.assert_allclose(out.transforms, np.broadcast_to(turn, (722, 3, 3)), atol=1e-5)


def test_relabelling_changes_nothing(bar, bar_problem, bar_targets):
    rng = np.random.default_rng(1)
    order = rng.permutation(722)
    place = np.argsort(order)
    other = jd.Mesh(bar.vertices[order], place[bar.faces][rng.permutation(1440)])
    handles = rng.permutation(place[bar_problem.handles])
    targets = jd.bend(bar.vertices, 90.0)[order[handles]]
    problem = jd.precompute(other, handles)
    want = jd.deform(bar_problem, bar_targets, 0.5, solver=TWENTY).vertices
    # Both start shapes and 20 contractions are linear algebra; bend's middle is the bar's here.
    middle = jd.bend(bar.vertices[bar_problem.handles], 90.0)
    np.testing.assert_allclose(jd.bend(bar.vertices, 90.0)[bar_problem.handles], middle, atol=EXACT)
    got = jd.deform(problem, targets, 0.5, solver=TWENTY).vertices
    assert relative(got[place], want) < 1e-9


def test_scaling_by_s_is_rigidity_by_s_squared(bar, bar_problem, bar_targets):
    s = 1e-3
    small = jd.precompute(jd.Mesh(s * bar.vertices, bar.faces), bar_problem.handles)
    want = jd.deform(bar_problem, bar_targets, 4.0, solver=TWENTY).vertices
    got = jd.deform(small, s * bar_targets, s**2 * 4.0, solver=TWENTY).vertices
    assert relative(got / s, want) < 1e-9


def test_the_shape_moves_in_proportion_to_rigidity(bar_problem, bar_targets):
    def shape(lam):
        out = jd.deform(bar_problem, bar_targets, lam, solver=jd.Alternating(100))
        return np.asarray(out.vertices)

    base = shape(30.0)
    little, much = np.linalg.norm(shape(30.01) - base), np.linalg.norm(shape(31.0) - base)
    assert 0.8 < much / (100 * little) < 1.2


def test_the_sheared_square_of_fig_4_2():
    """A sheared centre: at small rigidity the square shears, at a large one it cannot."""
    mesh = jd.shapes.square()
    shear = np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]])
    sheared = mesh.vertices @ shear.T
    handles = np.array([1, 3, 4, 5, 7])  # the centre and its four spokes
    problem = jd.precompute(mesh, handles)
    error, strain = [], []
    for lam in (0.01, 1.5, 10.0):
        out = jd.deform(problem, sheared[handles], lam)
        error.append(np.linalg.norm(out.vertices - sheared))
        t = np.asarray(out.transforms)
        strain.append(np.linalg.norm(np.swapaxes(t, 1, 2) @ t - np.eye(3), axis=(1, 2)).max())
    assert error[0] < 0.02
    assert error[0] < error[1] < error[2]
    assert strain[0] > strain[1] > strain[2]


def test_rigidity_to_infinity_is_arap(bar, bar_problem, bar_targets):
    """On the same cells T tends to the rotation, and the shape with it, as 1 / lambda."""
    rigid = jd.deform(bar_problem, bar_targets, 0.0, local=jd.RotationFit(), solver=TWENTY)
    gap = [
        relative(jd.deform(bar_problem, bar_targets, lam, solver=TWENTY).vertices, rigid.vertices)
        for lam in (1e4, 1e5, 1e6)
    ]
    assert gap[0] < 0.05
    assert 8 < gap[0] / gap[1] < 12
    assert 8 < gap[1] / gap[2] < 12


def test_normals_hold_a_flat_sheet():
    """Eq. 4.7: without it nothing resists a fold of the plane, and T is rank deficient."""
    mesh = jd.shapes.square()
    handles = np.array([0, 6, 8])  # not on one line, or the sheet could swing about it
    problem = jd.precompute(mesh, handles)
    turned = np.asarray(jd.rotate(mesh.vertices, 30.0, axis="y", center=[0, 0, 0]))
    out = jd.deform(problem, turned[handles], 1.0, normals=True, solver=jd.Alternating(2000))
    assert relative(out.vertices, turned) < 1e-3
    np.testing.assert_allclose(np.linalg.det(np.asarray(out.transforms)), 1.0, atol=1e-2)


def test_soft_handles_tend_to_hard_ones(bar, bar_problem, bar_targets):
    hard = jd.deform(bar_problem, bar_targets, 0.5).vertices
    gap = []
    for weight in (1.0, 100.0, 1e4):
        problem = jd.precompute(bar, bar_problem.handles, handle_weights=weight)
        gap.append(relative(jd.deform(problem, bar_targets, 0.5).vertices, hard))
    assert gap[0] > gap[1] > gap[2]
    assert gap[2] < 1e-2


def test_the_submesh_is_the_whole(bar):
    mesh = jd.shapes.cactus()
    free = np.flatnonzero((mesh.vertices[:, 0] > 0.9) & (mesh.vertices[:, 1] < 3.1))
    fixed = np.setdiff1d(np.arange(mesh.n_vertices), free)
    positions = mesh.vertices.copy()
    tip = (mesh.vertices[:, 0] > 0.9) & (mesh.vertices[:, 1] >= 3.1)
    positions[tip] += [0.3, -0.2, 0.4]
    rng = np.random.default_rng(2)
    cells = jd.rings(mesh, rng.integers(1, 3, mesh.n_vertices))
    rigidity = rng.uniform(0.01, 0.5, mesh.n_vertices)
    whole = jd.precompute(mesh, fixed, cells=cells)
    want = jd.deform(whole, positions[fixed], rigidity, solver=TWENTY)
    part = jd.cut(mesh, free, cells)
    assert part.mesh.n_vertices < 0.3 * mesh.n_vertices
    problem = jd.precompute(part.mesh, part.handles, cells=part.cells)
    out = jd.deform(
        problem,
        positions[part.index][part.handles],
        rigidity[part.index],
        solver=TWENTY,
    )
    assert relative(part.restore(out.vertices, positions), want.vertices) < 1e-9


# ---------------------------------------------------------------- transformations of JAX


@pytest.mark.parametrize(
    ("solver", "adjoint"),
    [
        (jd.Alternating(30), jd.Unrolled()),
        (jd.Alternating(2000), jd.Implicit()),
        (jd.QuasiNewton(tolerance=1e-15), jd.Implicit()),
    ],
)
def test_derivatives_by_differences(bar_problem, bar_targets, solver, adjoint):
    rng = np.random.default_rng(3)
    weight = jnp.asarray(rng.normal(size=(722, 3)))
    lam = jnp.asarray(rng.uniform(0.5, 5.0, 722))
    targets = jnp.asarray(bar_targets)
    dlam, dtargets = lam * rng.normal(size=722), jnp.asarray(rng.normal(size=targets.shape))

    def loss(targets, lam):
        out = jd.deform(bar_problem, targets, lam, solver=solver, adjoint=adjoint)
        return jnp.sum(weight * out.vertices) + jnp.sum(out.transforms**2) + out.energy[-1]

    loss = jax.jit(loss)
    h = 1e-4
    want = loss(targets + h * dtargets, lam + h * dlam) - loss(
        targets - h * dtargets, lam - h * dlam
    )
    want = float(want) / (2 * h)
    _, forward = jax.jvp(loss, (targets, lam), (dtargets, dlam))
    np.testing.assert_allclose(forward, want, rtol=FD)
    gt, gl = jax.grad(loss, (0, 1))(targets, lam)
    np.testing.assert_allclose(jnp.sum(gt * dtargets) + jnp.sum(gl * dlam), want, rtol=FD)


def test_vmap_over_targets_rigidity_and_start(bar, bar_problem, bar_targets):
    targets = jnp.stack([jnp.asarray(bar_targets), jnp.asarray(bar_targets) + 3.0])
    lam = jnp.asarray([0.1, 10.0])
    start = jnp.stack([jnp.asarray(bar.vertices)] * 2)

    def one(t, r, s):
        return jd.deform(bar_problem, t, r, start=s, solver=TWENTY).vertices

    batch = jax.jit(jax.vmap(one))(targets, lam, start)
    for k in range(2):
        assert relative(batch[k], one(targets[k], lam[k], start[k])) < 1e-9
    mixed = jax.vmap(lambda r: jd.deform(bar_problem, bar_targets, r).vertices)(lam)
    for k in range(2):
        assert relative(mixed[k], jd.deform(bar_problem, bar_targets, lam[k]).vertices) < 1e-6


def test_queue_of_lanes_is_every_lane_alone(bar, bar_problem, bar_targets):
    """More lanes than iterate together, of unlike lengths, one of them broken; nested vmap too."""
    lam = np.geomspace(0.01, 100.0, 2 * lbfgs.SLOTS + 5)

    def one(r):
        return jd.deform(bar_problem, bar_targets, r)

    single = jax.jit(one)
    want = [single(r) for r in lam]
    broken = len(lam) // 3
    rigidity = lam.copy()
    rigidity[broken] = np.nan  # only a traced number can be one: others are refused
    got = jax.jit(jax.vmap(one))(rigidity)
    for k, alone in enumerate(want):
        if k == broken:
            assert "Not finite" in str(jd.Result(got.result.code[k]))
            continue
        np.testing.assert_allclose(got.vertices[k], alone.vertices, atol=1e-4)
        assert abs(int(got.steps[k]) - int(alone.steps)) <= 2  # sums are in another order
        energy = np.asarray(got.energy[k])
        np.testing.assert_allclose(energy[-1], alone.energy[-1], rtol=1e-7)
        steps = int(got.steps[k])
        np.testing.assert_array_equal(energy[steps:], energy[-1])
        assert np.all(np.diff(energy) <= 1e-9 * np.abs(energy[:-1]))
    assert jax.vmap(one)(jnp.zeros(0)).vertices.shape == (0, *bar.vertices.shape)
    nested = jax.jit(jax.vmap(jax.vmap(one)))(jnp.asarray(lam[:6]).reshape(2, 3))
    np.testing.assert_allclose(
        nested.vertices.reshape(6, *bar.vertices.shape), got.vertices[:6], atol=1e-4
    )


@pytest.mark.slow
def test_sparse_factor_under_jit_vmap_grad():
    """Above 1000 vertices the factor is on the host: the same must hold there."""
    mesh = jd.shapes.cylinder()
    handles = ends(mesh)
    problem = jd.precompute(mesh, handles)
    targets = jnp.asarray(jd.bend(mesh.vertices[handles], 30.0))
    solver = jd.Alternating(4)
    loss = lambda r: jnp.sum(jd.deform(problem, targets, r, solver=solver).vertices ** 2)  # noqa: E731
    batch = jax.jit(jax.vmap(jax.value_and_grad(loss)))(jnp.asarray([0.01, 0.1]))
    for k, r in enumerate((0.01, 0.1)):
        h = 1e-4 * r
        np.testing.assert_allclose(batch[0][k], loss(r), rtol=1e-9)
        np.testing.assert_allclose(batch[1][k], (loss(r + h) - loss(r - h)) / (2 * h), rtol=FD)


def test_single_precision(bar, bar_problem, bar_targets):
    problem = jd.precompute(bar, bar_problem.handles, dtype=np.float32)
    low = jd.deform(problem, bar_targets, 1.0)
    assert low.vertices.dtype == jnp.float32
    assert bool(low.result.ok)
    assert relative(low.vertices, jd.deform(bar_problem, bar_targets, 1.0).vertices) < 1e-3
    assert float(low.energy[-1]) < 1.001 * float(
        jd.deform(bar_problem, bar_targets, 1.0).energy[-1]
    )


def test_other_handles_do_not_recompile(bar, bar_targets, bar_problem):
    mesh = jd.shapes.cylinder()
    y = mesh.vertices[:, 1]
    jd.deform(jd.precompute(mesh, ends(mesh)), mesh.vertices[ends(mesh)], 0.1, solver=TWENTY)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name) if "backend_compile" in name else None
    )
    for part in (y < 1, (y < 2) | (y > 11), y > 7):
        handles = np.flatnonzero(part)
        problem = jd.precompute(mesh, handles)
        compiled.clear()
        for shift in (0.1, 0.2):
            jd.deform(problem, mesh.vertices[handles] + shift, shift, solver=TWENTY)
        assert compiled == []


def test_a_gone_problem_says_so():
    mesh = jd.shapes.cylinder()
    problem = jd.precompute(mesh, [0])
    run = jax.jit(lambda system, b: system.factor.solve(b))
    system = problem.system
    del problem
    with pytest.raises(Exception, match="keep the problem"):
        jax.block_until_ready(run(system, jnp.ones((3, 4802))))


# ---------------------------------------------------------------- ends, results, odd meshes


def test_results_say_what_happened(bar_problem, bar_targets):
    ran = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.Alternating(3))
    assert "number of steps" in str(ran.result)
    assert int(ran.steps) == 3
    assert ran.energy.shape == (4,)
    early = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.Alternating(1000, tolerance=1e-4))
    assert "Converged" in str(early.result)
    assert int(early.steps) < 200
    late = jd.deform(bar_problem, bar_targets, 1.0, solver=jd.QuasiNewton(max_steps=2))
    assert "step limit" in str(late.result)
    assert not bool(late.result.ok)
    both = jax.vmap(lambda r: jd.deform(bar_problem, bar_targets, r).result)(
        jnp.asarray([0.1, 1.0])
    )
    assert "Converged" in str(both)


def test_overflow_is_reported_not_raised(bar):
    problem = jd.precompute(bar, ends(bar), dtype=np.float32)
    out = jd.deform(problem, 1e30 * bar.vertices[ends(bar)], 1.0, solver=jd.Alternating(3))
    assert "Not finite" in str(out.result)


def test_all_vertices_handles(bar):
    problem = jd.precompute(bar, np.arange(722))
    moved = bar.vertices * 1.1
    np.testing.assert_allclose(jd.deform(problem, moved, 1.0).vertices, moved, rtol=EXACT)
    big = jd.shapes.cylinder()
    problem = jd.precompute(big, np.arange(4802))
    np.testing.assert_allclose(
        jd.deform(problem, big.vertices, 1.0).vertices, big.vertices, atol=EXACT
    )


def test_unreferenced_vertices_stay_and_components_stand_alone(bar):
    aside = np.array([100.0, 0.0, 0.0])
    two = np.concatenate([bar.vertices, bar.vertices + aside, [[7.0, 8.0, 9.0]]])
    mesh = jd.Mesh(two, np.concatenate([bar.faces, bar.faces + 722]))
    one = ends(bar)
    handles = np.concatenate([one, one + 722])
    targets = np.concatenate([jd.bend(bar.vertices[one]), two[one + 722]])
    problem = jd.precompute(mesh, handles)
    out = np.asarray(jd.deform(problem, targets, 1.0, solver=TWENTY).vertices)
    alone = jd.deform(jd.precompute(bar, one), targets[: len(one)], 1.0, solver=TWENTY).vertices
    np.testing.assert_allclose(out[-1], [7, 8, 9], atol=1e-12)
    assert relative(out[:722], alone) < 1e-9
    np.testing.assert_allclose(out[722:-1], bar.vertices + aside, atol=1e-6)


@pytest.mark.parametrize("name", ["fan3.obj", "hourglass_ico.obj", "plate4SD.ply", "bar1.off"])
def test_odd_meshes_deform(name):
    """Non-manifold edge and vertex, open border, faces inwards."""
    mesh = real_mesh(name)
    handles = np.unique([0, mesh.n_vertices // 2, mesh.n_vertices - 1])
    out = jd.deform(jd.precompute(mesh, handles), mesh.vertices[handles], 1.0)
    assert relative(out.vertices, mesh.vertices) < 1e-5


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_tiny_and_huge(bar, bar_targets, scale):
    problem = jd.precompute(jd.Mesh(scale * bar.vertices, bar.faces), ends(bar))
    out = jd.deform(problem, scale * bar_targets, scale**2)
    assert bool(out.result.ok)
    assert np.linalg.det(np.asarray(out.transforms)).min() > 0


def bad_calls(bar, problem, targets):
    nan = targets.copy()
    nan[5] = np.nan
    loose = jd.Mesh(
        np.concatenate([bar.vertices, bar.vertices + 500]),
        np.concatenate([bar.faces, bar.faces + 722]),
    )
    short = jd.shapes.square()
    return {
        "handle 722 .*out of range": lambda: jd.precompute(bar, [0, 722]),
        "handle -1 .*out of range": lambda: jd.precompute(bar, [-1]),
        "vertex 3 is a handle 2 times": lambda: jd.precompute(bar, [3, 4, 3]),
        "no handles": lambda: jd.precompute(bar, []),
        "handles must be integers": lambda: jd.precompute(bar, [0.5]),
        "one list of vertex indices": lambda: jd.precompute(bar, [[0, 1]]),
        "part with vertex 722 .*no handle": lambda: jd.precompute(loose, [0]),
        "cells are of another mesh": lambda: jd.precompute(bar, [0], cells=jd.rings(short, 1)),
        "weight of handle 0 is -1": lambda: jd.precompute(bar, [0], handle_weights=-1.0),
        "r = 0 at vertex": lambda: jd.rings(bar, 0),
        "r has shape": lambda: jd.rings(bar, [1, 2]),
        "r must be an integer": lambda: jd.rings(bar, 1.5),
        "weights have shape": lambda: jd.rings(bar, 1, weights=[1.0]),
        "the weight of edge 0 is nan": lambda: jd.rings(bar, 1, weights=np.full(2160, np.nan)),
        "targets have shape": lambda: jd.deform(problem, targets[:-1], 1.0),
        "targets of handle 5 are not finite": lambda: jd.deform(problem, nan, 1.0),
        "targets cannot be read": lambda: jd.deform(problem, "north", 1.0),
        "rigidity is -1.0": lambda: jd.deform(problem, targets, -1.0),
        "rigidity is nan at vertex 2": lambda: jd.deform(
            problem, targets, np.where(np.arange(722) == 2, np.nan, 1.0)
        ),
        "rigidity has shape": lambda: jd.deform(problem, targets, [1.0, 2.0]),
        "start have shape": lambda: jd.deform(problem, targets, 1.0, start=targets),
        "0 steps": lambda: jd.deform(problem, targets, 1.0, solver=jd.Alternating(0)),
        "Unrolled": lambda: jd.deform(
            problem, targets, 1.0, solver=jd.QuasiNewton(), adjoint=jd.Unrolled()
        ),
        "with normals": lambda: jd.deform(
            problem, targets, 1.0, normals=True, solver=jd.QuasiNewton()
        ),
        "free vertex 722": lambda: jd.cut(bar, [722]),
        "no vertex is free": lambda: jd.cut(bar, np.zeros(722, bool)),
        "dtype float16": lambda: jd.precompute(bar, [0], dtype=np.float16),
    }


MESSAGES = list(bad_calls(jd.shapes.bar(), None, np.zeros((9, 3))))


@pytest.mark.parametrize("message", MESSAGES)
def test_bad_input_gets_a_clear_error(bar, bar_problem, bar_targets, message):
    call = bad_calls(bar, bar_problem, bar_targets)[message]
    with pytest.raises(jd.InputError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_shape_errors_also_come_while_tracing(bar_problem, bar_targets):
    with pytest.raises(jd.InputError, match="targets have shape"):
        jax.jit(lambda t: jd.deform(bar_problem, t, 1.0).vertices)(bar_targets[:-1])
