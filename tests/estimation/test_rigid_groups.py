"""Handles found."""

import numpy as np
import pytest
from helpers import noisy, real_mesh

import jaxdeform as jd


def test_handles_are_found_exactly(bar, bar_problem, pose_of):
    pose = pose_of(1.0)
    np.testing.assert_array_equal(jd.find_handles(bar, pose), bar_problem.handles)
    groups = jd.find_handle_groups(bar, pose)
    assert sorted(round(float(group.degrees[0]), 6) for group in groups) == [0.0, 90.0]
    for group in groups:
        moved = bar.vertices[group.vertices] @ group.rotations[0].T + group.translations[0]
        np.testing.assert_allclose(moved, pose[group.vertices], atol=1e-9)


def test_handles_are_found_in_noise_and_in_several_poses(bar, bar_problem, pose_of):
    poses = np.stack([noisy(bar, pose_of(value), seed) for seed, value in enumerate((1.0, 30.0))])
    with pytest.raises(jd.InputError, match="raise the tolerance"):
        jd.find_handles(bar, poses, tolerance=1e-6)
    found = jd.find_handles(bar, poses)
    assert np.isin(bar_problem.handles, found).mean() > 0.98
    assert np.isin(found, bar_problem.handles).mean() > 0.95


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-4])
def test_the_tolerance_follows_from_the_noise(noise):
    """The ends of a rolled plate are two rows of vertices each, which its rest shape shows."""
    rest, pose = real_mesh("plate4SD.ply"), real_mesh("plate4SD_rolledA.ply")
    groups = jd.find_handle_groups(rest, noisy(rest, pose.vertices, 0, noise))
    along = int(np.argmax(np.ptp(rest.vertices, axis=0)))
    place = rest.vertices[:, along]
    for group in groups:
        assert len(group.vertices) == 66
        assert len(np.unique(place[group.vertices].round(6))) == 2
    assert len(groups) == 2


@pytest.mark.parametrize(
    ("rest", "pose"), [("plate4SD.ply", "plate4SD_rolledA.ply"), ("finger0.ply", "finger1.ply")]
)
def test_where_noise_hides_the_handles_that_is_said(rest, pose):
    rest, pose = real_mesh(rest), real_mesh(pose)
    with pytest.warns(UserWarning, match="vertices moved rigidly within .* compare the estimates"):
        jd.find_handles(rest, noisy(rest, pose.vertices, 0, 1e-3))


@pytest.mark.parametrize("rigidity", [0.1, 30.0])
def test_few_handles_of_an_exact_pose_are_found(bar, rigidity):
    """Two vertices with their neighbours: fewer rings than the noise is taken from."""
    rings = [np.append(bar.edges[(bar.edges == k).any(axis=1)].ravel(), k) for k in (200, 500)]
    lower, upper = map(np.unique, rings)
    handles = np.concatenate([lower, upper])
    targets = bar.vertices[handles].copy()
    targets[len(lower) :] += [5.0, 20.0, 10.0]
    pose = jd.deform(jd.precompute(bar, handles), targets, rigidity).vertices
    np.testing.assert_array_equal(jd.find_handles(bar, pose), np.sort(handles))


def test_finding_handles_does_not_depend_on_where_the_pose_lies(bar, bar_problem, pose_of):
    moved = np.asarray(jd.rotate(pose_of(1.0), 40.0, axis=[1.0, 2.0, 3.0])) + 7.0
    np.testing.assert_array_equal(jd.find_handles(bar, moved), bar_problem.handles)


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-4])
def test_the_phalanges_of_a_finger_are_found(noise):
    rest, pose = real_mesh("finger0.ply"), real_mesh("finger1.ply")
    groups = jd.find_handle_groups(rest, noisy(rest, pose.vertices, 0, noise))
    assert [len(group.vertices) > 150 for group in groups] == [True] * 4
