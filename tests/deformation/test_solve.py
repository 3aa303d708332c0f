"""The main job: peers, results, odd meshes, and what happens to bad input."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg
from helpers import EXACT, PEER, TWENTY, ends, real_mesh, relative

import jaxdeform as jd
from benchmarks.harness import compilations


def plain_arap(mesh, handles, targets, start, steps):
    """Eq. 3.3 in NumPy, float64 throughout: spokes, LAPACK's SVD, SciPy's LU."""
    n, (i, j) = mesh.n_vertices, mesh.edges.T
    w = np.maximum(jd.cotangent_weights(mesh), 0.0)
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


@pytest.mark.parametrize("name", ["bar", "cylinder", "cactus", "cactus.off"])
@pytest.mark.filterwarnings("ignore:negative weights")
def test_rotation_fit_on_spokes_is_arap(name):
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
    if (jd.cotangent_weights(mesh) < 0).any():
        return  # libigl keeps negative weights
    data = igl.ARAPData()
    data.energy = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_SPOKES
    data.max_iter = 20
    igl.arap_precomputation(mesh.vertices, mesh.faces, 3, handles, data)
    assert relative(out, igl.arap_solve(targets, data, start.copy())) < PEER


def test_single_precision(bar, bar_problem, bar_targets):
    problem = jd.precompute(bar, bar_problem.handles, dtype=np.float32)
    low = jd.deform(problem, bar_targets, 1.0)
    assert low.vertices.dtype == jnp.float32
    assert bool(low.ok)
    high = jd.deform(bar_problem, bar_targets, 1.0)
    assert relative(low.vertices, high.vertices) < 1e-3
    found = [np.asarray(x, np.float64) for x in (low.vertices, low.transforms)]
    assert jd.energy(bar_problem, *found, 1.0) < (1 + 1e-5) * high.energy[-1]
    # What it says of it is a difference of sums 600 times as large.
    np.testing.assert_allclose(low.energy[-1], high.energy[-1], rtol=2e-3)


def test_other_handles_do_not_recompile(bar, bar_targets, bar_problem):
    mesh = jd.shapes.cylinder()
    y = mesh.vertices[:, 1]
    jd.deform(jd.precompute(mesh, ends(mesh)), mesh.vertices[ends(mesh)], 0.1, solver=TWENTY)
    for part in (y < 1, (y < 2) | (y > 11), y > 7):
        handles = np.flatnonzero(part)
        problem = jd.precompute(mesh, handles)
        with compilations() as compiled:
            for shift in (0.1, 0.2):
                jd.deform(problem, mesh.vertices[handles] + shift, shift, solver=TWENTY)
                start = mesh.vertices + 0.01
                jd.deform(problem, mesh.vertices[handles], shift, solver=TWENTY, start=start)
        assert compiled == []


def test_another_tolerance_does_not_recompile(bar_problem, bar_targets):
    def run(tolerance):
        rough, fine = jd.QuasiNewton(tolerance), jd.Alternating(500, tolerance=tolerance)
        adjoint = jd.Implicit(tolerance)

        def height(r):
            out = jd.deform(bar_problem, bar_targets, r, solver=rough, adjoint=adjoint)
            return out.vertices[:, 1].mean()

        steps = jd.deform(bar_problem, bar_targets, 1.0, solver=rough).steps
        fewer = jd.deform(bar_problem, bar_targets, 1.0, solver=fine).steps
        path = jd.deform_path(bar_problem, bar_targets[None], 1.0, solver=rough).steps[0]
        return [int(steps), int(fewer), int(path)], float(jax.grad(height)(1.0))

    few, gradient = run(1e-3)
    with compilations() as compiled:
        more, close = run(1e-6)
        other, same = run(1e-3)
    assert compiled == []
    assert other == few
    assert all(a < b for a, b in zip(few, more, strict=True)), (few, more)
    assert same == gradient
    np.testing.assert_allclose(gradient, close, rtol=1e-3)


def test_a_solver_that_equals_nothing_but_itself_does_not_recompile(bar_problem, bar_targets):
    class Own:
        can_unroll, needs_one_energy = False, True
        default_adjoint = jd.Implicit()

        def minimize(self, *arguments):
            return jd.QuasiNewton(max_steps=5).minimize(*arguments)

    solver = Own()
    first = jd.deform(bar_problem, bar_targets, 1.0, solver=solver)
    with compilations() as compiled:
        second = jd.deform(bar_problem, bar_targets, 1.0, solver=solver)
    assert compiled == []
    np.testing.assert_array_equal(first.vertices, second.vertices)


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
    assert not bool(late.ok)
    both = jax.vmap(lambda r: jd.deform(bar_problem, bar_targets, r).result)(
        jnp.asarray([0.1, 1.0])
    )
    assert str(both).count("Converged") == 2


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
    assert bool(out.ok)
    assert np.linalg.det(np.asarray(out.transforms)).min() > 0


def bad_calls(bar, problem, targets):
    nan = targets.copy()
    nan[5] = np.nan
    loose = jd.Mesh(
        np.concatenate([bar.vertices, bar.vertices + 500]),
        np.concatenate([bar.faces, bar.faces + 722]),
    )
    rings, short = jd.rings(bar, 1), jd.shapes.square()
    order = np.random.default_rng(0).permutation(722)
    turned = jd.Mesh(bar.vertices[np.argsort(order)], order[bar.faces])  # numbered anew
    return {
        "handle 722 .*out of range": lambda: jd.precompute(bar, [0, 722]),
        "handle -1 .*out of range": lambda: jd.precompute(bar, [-1]),
        "vertex 3 is a handle 2 times": lambda: jd.precompute(bar, [3, 4, 3]),
        "no handles": lambda: jd.precompute(bar, []),
        "handles must be integers": lambda: jd.precompute(bar, [0.5]),
        "one list of vertex indices": lambda: jd.precompute(bar, [[0, 1]]),
        "component with vertex 722 .*no handle": lambda: jd.precompute(loose, [0]),
        "cells are of another mesh": lambda: jd.precompute(bar, [0], cells=jd.rings(short, 1)),
        "another mesh .*: call rings": lambda: jd.precompute(turned, [0], cells=rings),
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
        "start has shape": lambda: jd.deform(problem, targets, 1.0, start=targets),
        "steps of Alternating is 0": lambda: jd.deform(
            problem, targets, 1.0, solver=jd.Alternating(0)
        ),
        "Unrolled": lambda: jd.deform(
            problem, targets, 1.0, solver=jd.QuasiNewton(), adjoint=jd.Unrolled()
        ),
        "with normals": lambda: jd.deform(
            problem, targets, 1.0, normals=True, solver=jd.QuasiNewton()
        ),
        "free vertex 722": lambda: jd.submesh(bar, [722]),
        "no vertex is free": lambda: jd.submesh(bar, np.zeros(722, bool)),
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


def test_lengths_that_differ_by_five_orders():
    """A strip whose edges grow from 1 to 2.6e5: the factor of the first guess was not definite."""
    along = np.cumsum(1.5 ** np.arange(31))
    points = np.stack([np.repeat(along, 2), np.tile([0.0, 1.0], 31), np.zeros(62)], axis=1)
    pair = 2 * np.arange(30)[:, None, None] + [[0, 2, 1], [1, 2, 3]]
    mesh = jd.Mesh(points, pair.reshape(-1, 3))
    handles, shift = [0, 1, 60, 61], np.array([0.0, 0.0, 1e4])
    out = jd.deform(jd.precompute(mesh, handles), mesh.vertices[handles] + shift, 1.0)
    # It moves along by 1.7 % of the diagonal, as well as energies tell that are rounded to 20.
    off = np.abs(np.asarray(out.vertices) - mesh.vertices - shift).max()
    assert off < 2e-3 * mesh.diagonal
    assert out.result in (jd.Result.converged, jd.Result.out_of_proportion)


@pytest.mark.filterwarnings("ignore:negative weights")
def test_a_flattened_cylinder_moves_along():
    """Its triangles are 1e-8 high; by lengths they have no area, and their cotangents were NaN."""
    cylinder = jd.shapes.cylinder()
    mesh = jd.Mesh(cylinder.vertices * [1, 1, 1e-8], cylinder.faces)
    handles, shift = ends(mesh), np.array([0.1, 0, 0])
    out = jd.deform(jd.precompute(mesh, handles), mesh.vertices[handles] + shift, 1.0)
    assert out.result == jd.Result.converged
    np.testing.assert_allclose(out.vertices, mesh.vertices + shift, atol=1e-6)
