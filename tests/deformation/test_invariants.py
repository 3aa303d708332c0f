"""What a deformation keeps, and its limits."""

import jax
import numpy as np
import pytest
from helpers import EXACT, TWENTY, relative
from scipy.spatial.transform import Rotation

import jaxdeform as jd


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
    assert bool(fast.ok)


@pytest.mark.slow
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
    # Near 0 the energy tells positions apart only to the square root of its rounding.
    assert relative(out.vertices, moved) < 3e-6
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
