"""Frames of a path whose shape has jumped to another equilibrium."""

import jax
import numpy as np
import pytest
from helpers import TWENTY, ends, real_mesh

import jaxdeform as jd


def twisted(problem, angles, rigidity, **settings):
    """Return the targets of a twist by these angles, and the frames of the path."""
    points = problem.mesh.vertices[problem.handles]
    targets = np.stack([jd.twist(points, angle) for angle in angles]).astype(problem.dtype)
    return targets, jd.deform_path(problem, targets, rigidity, **settings)


@pytest.mark.slow
def test_only_what_followed_the_handles_goes_back_with_them(bar_problem):
    """Back by one frame, a shape that followed is as it was; one that jumped is another."""
    rigidity = jd.rigidity_from_material(bar_problem, 0.2)
    targets, out = twisted(bar_problem, np.arange(10, 361, 10), rigidity)
    jumped, energy = np.asarray(out.jumped), np.asarray(out.energy)[:, -1]
    assert not np.any(jumped[:20])
    assert np.any(jumped)
    for k in (1, 5, 20, 35, *np.flatnonzero(jumped)):
        back = jd.deform(bar_problem, targets[k - 1], rigidity, start=out.vertices[k])
        same = abs(float(back.energy[-1]) / energy[k - 1] - 1) < 1e-3
        assert same == (not jumped[k]), k


@pytest.mark.slow
@pytest.mark.parametrize("frames", [12, 36, 72])
def test_the_loss_of_a_turn_is_told(frames):
    """The stiff bar of the thesis slips between 240 and 250 degrees, and ends at rest."""
    mesh = real_mesh("bar1.off")
    problem = jd.precompute(mesh, ends(mesh))
    angles = np.linspace(0, 360, frames + 1)[1:]
    _, out = twisted(problem, angles, 1000.0)
    assert np.abs(np.asarray(out.vertices[-1]) - mesh.vertices).max() < 1e-3
    assert not np.any(out.flipped)
    first = int(np.argmax(out.jumped))
    assert out.jumped[first]
    assert 240 < angles[first] <= 270
    sentence = "The shape jumped to another equilibrium."
    for k in (first - 1, first):
        told = jax.tree.map(lambda x, k=k: x[k], out).explain()
        assert told.endswith(sentence) == (k == first)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_nothing_is_told_of_a_path_there_and_back(bar, dtype):
    problem = jd.precompute(bar, ends(bar), dtype=dtype)
    angles = [30, 60, 90, 90, 60, 30, 0, 0, 0]
    _, out = twisted(problem, angles, 30.0)
    assert np.all(out.ok)
    np.testing.assert_allclose(out.vertices[-1], bar.vertices, atol=0.1)
    assert not np.any(out.jumped)


def test_nothing_is_told_of_frames_that_have_not_converged(bar_problem):
    _, out = twisted(bar_problem, [10, 20, 30, 0, 0], 30.0, solver=TWENTY)
    assert not np.any(out.jumped)
