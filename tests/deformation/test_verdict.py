"""What is said of a deformation: results under jit, cells inside out, errors on request."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CUBE, held_sheet
from scipy.spatial.transform import Rotation

import jaxdeform as jd
from jaxdeform._deformation.descent import Descent
from jaxdeform._deformation.reduced_energy import Inputs
from jaxdeform._deformation.verdict import verdict

R = jd.Result


@pytest.fixture(scope="module")
def sheet():
    mesh, handles, targets = held_sheet()
    return jd.precompute(mesh, handles, handle_weights=2.0), targets


def test_bad_values_inside_jit_are_said(sheet):
    problem, targets = sheet
    run = jax.jit(lambda t, r, w: jd.deform(problem, t, r, handle_weights=w).result)
    handles = len(problem.handles)
    rigidity, weights = np.ones(problem.n_vertices), np.full(handles, 2.0)
    cases = [
        (targets, rigidity, weights, R.converged),
        (targets, -100 * rigidity, weights, R.bad_input),
        (targets, np.where(np.arange(len(rigidity)) == 7, -1e-9, 1.0), weights, R.bad_input),
        (targets, rigidity * np.nan, weights, R.bad_input),
        (targets, rigidity * np.inf, weights, R.bad_input),
        (
            np.where(np.arange(handles)[:, None] == 3, np.nan, targets),
            rigidity,
            weights,
            R.bad_input,
        ),
        (targets, rigidity, -weights, R.bad_input),
        (targets, rigidity, 1.1 * weights, R.bad_input),
    ]
    for *arguments, want in cases:
        assert run(*map(jnp.asarray, arguments)) == want


def test_an_end_out_of_proportion_is_no_result(sheet):
    problem, _ = sheet
    system, one = problem.system, jnp.ones(problem.n_vertices)
    inputs = Inputs(system.rest, one, system.soft)
    size = float(jnp.abs(system.rest).max())

    def of(positions, energy):
        history = jnp.asarray([1.0, energy])
        t = jnp.zeros((3, *system.rest.shape))
        steps = jnp.asarray(1, jnp.int32)
        end = Descent(positions, t, history, jnp.asarray(1e-12), steps, R.converged)
        return verdict(system, inputs, end)

    assert of(system.rest, 0.5) == R.converged
    assert of(system.rest, -1e-13) == R.converged  # rounding
    assert of(system.rest, -1e-3) == R.out_of_proportion
    assert of(system.rest.at[1, 4].add(100 * size), 0.5) == R.out_of_proportion
    assert of(system.rest.at[1, 4].set(jnp.nan), 0.5) == R.not_finite


def test_a_mirror_image_is_counted_and_a_fold_is_not():
    """All vertices are handles, so the transformations are known."""
    mesh = jd.shapes.bar()
    problem = jd.precompute(mesh, np.arange(mesh.n_vertices))
    y = mesh.vertices[:, 1]
    mirrored = mesh.vertices * [1, 1, -1]
    turned = mesh.vertices @ Rotation.from_rotvec([3.0, 0.1, 0]).as_matrix().T
    # The upper half folded back by 180 degrees: sharp, but no cell is its mirror image there.
    folded = np.where(y[:, None] > 75, [[1, -1, -1]] * mesh.vertices, mesh.vertices)
    loose = {"rigidity": 0.0, "local": jd.AffineFit()}
    assert int(jd.deform(problem, mirrored, **loose).flipped) == mesh.n_vertices
    assert int(jd.deform(problem, turned, **loose).flipped) == 0
    fold = np.asarray(jd.deform(problem, folded, **loose).transforms)
    away = np.abs(y - 75) > 15
    assert (np.linalg.det(fold[away]) > 0).all()
    text = jd.deform(problem, mirrored, **loose).explain()
    assert "inside out (det T <= 0): 0, 1, 2, 3, 4, ... (722 of 722)" in text


def test_a_box_turned_over_its_handles_says_what_is_inside_out():
    """Three handles of a cube, turned by 170 degrees in their plane: the rest is on either side."""
    problem = jd.precompute(CUBE, [0, 1, 2])
    turn = Rotation.from_rotvec(np.radians(170) * np.array([1.0, 0, 0])).as_matrix()
    out = jd.deform(problem, CUBE.vertices[:3] @ turn.T, 1.0)
    orientation = np.linalg.det(np.asarray(out.transforms))
    assert int(out.flipped) == int((orientation <= 0).sum())
    assert ("inside out" in out.explain()) == bool(int(out.flipped))


def test_throw_raises_what_result_says(sheet):
    problem, targets = sheet
    short = {"solver": jd.QuasiNewton(max_steps=1)}
    with pytest.raises(Exception, match="Stopped at the step limit"):
        jd.deform(problem, targets, 1.0, throw=True, **short).vertices.block_until_ready()
    assert jd.deform(problem, targets, 1.0, **short).result == R.step_limit
    assert bool(jd.deform(problem, targets, 1.0, throw=True).ok)


def test_float32_far_from_the_origin_costs_no_digit_of_the_targets():
    near, handles, targets = held_sheet()
    shift = np.array([4e6, -2e6, 1e6])
    far = jd.Mesh(near.vertices + shift, near.faces)
    exact = jd.deform(jd.precompute(near, handles), targets, 1.0).vertices
    with pytest.warns(UserWarning, match="diagonals from the origin"):
        problem = jd.precompute(far, handles, dtype=np.float32)
    out = jd.deform(problem, targets + shift, 1.0)
    assert out.result == R.converged
    rounded = np.spacing(np.float32(4e6))  # of the position that comes back
    assert np.abs(np.asarray(out.vertices, float) - shift - exact).max() < 2 * rounded
    # Without the rounding of the sum: the energy is that near the origin.
    want = float(jd.deform(jd.precompute(near, handles, dtype=np.float32), targets, 1.0).energy[-1])
    assert abs(float(out.energy[-1]) - want) < 1e-3 * want
