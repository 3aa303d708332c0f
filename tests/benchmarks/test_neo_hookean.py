"""The other model, which makes poses to estimate from, against closed forms."""

import numpy as np
import pytest

import jaxdeform as jd
from benchmarks.held_out import FITTED, HELD_OUT, make_bar
from benchmarks.neo_hookean import NeoHookean, solid_box
from jaxdeform._estimation.held_out import prediction_errors

YOUNG, POISSON = 3.0, 0.3
SHEAR = YOUNG / (2 * (1 + POISSON))
BULK = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
SIZE = np.array([1.0, 2.0, 1.5])


@pytest.fixture(scope="module")
def solid():
    return solid_box((2, 4, 3), tuple(SIZE))


@pytest.fixture(scope="module")
def model(solid):
    return NeoHookean(solid, YOUNG, POISSON)


def test_a_box_is_filled_and_its_surface_closed(solid):
    corner = solid.nodes[solid.tetrahedra]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
    assert (volume > 0).all()
    np.testing.assert_allclose(volume.sum(), SIZE.prod())
    mesh, node = solid.surface()
    np.testing.assert_array_equal(mesh.vertices, solid.nodes[node])
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    # By the divergence theorem, if all faces look outwards.
    np.testing.assert_allclose(np.sum(a * np.cross(b, c)) / 6, SIZE.prod())
    assert mesh.n_vertices - len(mesh.edges) + len(mesh.faces) == 2


def test_small_strain_is_linear_elasticity(solid, model):
    gradient = 1e-5 * np.random.default_rng(0).normal(size=(3, 3))
    strain = (gradient + gradient.T) / 2
    linear = SHEAR * np.sum(strain**2) + BULK / 2 * np.trace(strain) ** 2
    moved = solid.nodes @ (np.eye(3) + gradient).T
    np.testing.assert_allclose(model.energy(moved), SIZE.prod() * linear, rtol=1e-3)


def test_turned_it_has_no_energy_and_inside_out_an_infinite_one(solid, model):
    turned = np.asarray(jd.rotate(solid.nodes, 70.0, axis=[1.0, 2.0, 3.0]))
    assert abs(model.energy(turned)) < 1e-12
    assert model.energy(solid.nodes * [1.0, 1.0, -1.0]) == np.inf


def test_pulled_at_all_sides_it_stretches_evenly(solid, model):
    outer = ((solid.nodes == 0) | (solid.nodes == SIZE)).any(axis=1)
    held, stretch = np.flatnonzero(outer), np.array([1.2, 0.9, 1.05])
    assert len(held) < len(solid.nodes)
    (pose,) = model.poses(held, (solid.nodes * stretch)[None, held])
    np.testing.assert_allclose(pose, solid.nodes * stretch, atol=1e-9)
    log = np.log(stretch.prod())
    density = SHEAR * ((stretch @ stretch - 3) / 2 - log) + BULK * log**2 / 2
    np.testing.assert_allclose(model.energy(pose), SIZE.prod() * density)


def test_a_pose_is_a_minimum(solid, model):
    held = np.flatnonzero((solid.nodes[:, 1] == 0) | (solid.nodes[:, 1] == SIZE[1]))
    upper = (solid.nodes[held, 1] > 1)[:, None]
    frames = [solid.nodes[held] + upper * s * np.array([0.5, 0.3, 0.0]) for s in (0.5, 1.0)]
    pose = model.poses(held, np.stack(frames))[-1]
    free = np.setdiff1d(np.arange(len(pose)), held)
    draw = np.random.default_rng(0)
    for _ in range(10):
        moved = pose.copy()
        moved[free] += draw.normal(scale=1e-4, size=(len(free), 3))
        assert model.energy(moved) > model.energy(pose)


@pytest.mark.slow
def test_fitted_halves_of_a_solid_predict_better_than_arap():
    """Another model made the poses: that is said, and yet the stiff half is found."""
    bar = make_bar(lambda height: np.where(height > 0.5, 10.0, 1.0))
    problem, seen = bar.problem, bar.stack(FITTED)
    fit = jd.estimate_rigidity(problem, seen, targets=seen[:, problem.handles], parts=bar.upper)
    assert fit.rigidity[1] > 10 * fit.rigidity[0]
    assert not fit.ok
    unseen = bar.stack(HELD_OUT)
    ours = prediction_errors(problem, unseen, fit.field, jd.Newton())
    arap = prediction_errors(problem, unseen, 0.0, jd.RotationFit())
    assert ours.mean() < 0.85 * arap.mean()
