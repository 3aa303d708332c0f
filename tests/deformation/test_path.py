"""Paths: every frame from the one before; turns that a single deformation cannot make."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, TIGHT, TWENTY, ends, relative

import jaxdeform as jd


def twists(mesh, problem, degrees, frames):
    """Return the targets (frames, handles, 3) of a twist in even steps."""
    points = mesh.vertices[problem.handles]
    return np.stack([jd.twist(points, a) for a in np.linspace(0, degrees, frames + 1)[1:]])


class Turn(NamedTuple):
    """A full turn of the stiff bar, to the last digit, so that energies agree to rounding."""

    problem: jd.Problem
    targets: np.ndarray
    rigidity: np.ndarray
    out: jd.Solution

    @classmethod
    def of(cls, mesh, degrees):
        problem = jd.precompute(mesh, ends(mesh))
        targets = twists(mesh, problem, degrees, 24)
        rigidity = np.asarray(jd.rigidity_from_material(problem, 10.0))
        return cls(
            problem, targets, rigidity, jd.deform_path(problem, targets, rigidity, solver=TIGHT)
        )


@pytest.fixture(scope="module")
def turn(bar) -> Turn:
    return Turn.of(bar, 360.0)


@pytest.mark.slow
def test_a_full_turn_is_not_the_rest_shape(bar, turn):
    problem, targets, rigidity, out = turn
    assert out.vertices.shape == (24, 722, 3)
    assert out.ok.shape == (24,)
    assert np.all(out.ok)
    assert not np.any(out.flipped)
    assert not np.any(out.jumped)
    np.testing.assert_allclose(targets[-1], bar.vertices[problem.handles], atol=EXACT)
    np.testing.assert_allclose(out.vertices[:, problem.handles], targets, atol=EXACT)
    last = np.asarray(out.energy)[:, -1]
    assert np.all(np.diff(last) > 0)
    # One deformation does not know that the handles have turned.
    plain = jd.deform(problem, targets[-1], rigidity, solver=TIGHT)
    assert np.abs(np.asarray(plain.vertices) - bar.vertices).max() < 1e-6
    assert np.abs(np.asarray(out.vertices[-1]) - bar.vertices).max() > 15  # of a bar 30 wide
    assert float(plain.energy[-1]) < 1e-6 * last[-1]


@pytest.mark.slow
def test_each_frame_is_the_deformation_from_the_one_before(bar, turn):
    problem, targets, rigidity, out = turn
    before = bar.vertices
    for k in (0, 1, 11, 23):
        if k:
            before = np.asarray(out.vertices[k - 1])
        alone = jd.deform(problem, targets[k], rigidity, solver=TIGHT, start=before)
        np.testing.assert_allclose(out.energy[k, -1], alone.energy[-1], rtol=1e-9)
        # Both end where rounding hides the energy's change, so positions agree to its root.
        np.testing.assert_allclose(out.vertices[k], alone.vertices, atol=1e-3)
    # The first frame is that of deform, step for step.
    first = jd.deform(problem, targets[0], rigidity, solver=TIGHT)
    np.testing.assert_allclose(out.vertices[0], first.vertices, atol=1e-9)
    assert int(out.steps[0]) == int(first.steps)


def test_frames_start_where_the_text_says(bar, turn):
    """A multiple of the last motion, and Laplacian editing of what the handles did besides."""
    problem, targets, rigidity, out = turn
    points, v, k = bar.vertices[problem.handles], np.asarray(out.vertices), 9
    pull, old = targets[k] - targets[k - 1], targets[k - 1] - targets[k - 2]
    share = np.sum(pull * old) / np.sum(old * old)
    edit = jd.laplacian_editing(bar, problem.handles, points + pull - share * old) - bar.vertices
    start = v[k - 1] + share * (v[k - 1] - v[k - 2]) + edit
    at = jd.deform(problem, targets[k], rigidity, solver=TIGHT, start=start)
    np.testing.assert_allclose(out.energy[k, 0], at.energy[0], rtol=1e-8)
    # It is nearer than the last frame itself.
    plain = jd.deform(problem, targets[k], rigidity, solver=TIGHT, start=v[k - 1])
    gap = np.asarray(at.energy[0] - at.energy[-1])
    assert gap < 0.1 * (plain.energy[0] - plain.energy[-1])


@pytest.mark.slow
def test_the_mirror_image_turns_the_other_way(bar, turn):
    mirror = np.array([-1.0, 1.0, 1.0])
    other = Turn.of(jd.Mesh(bar.vertices * mirror, bar.faces[:, ::-1]), -360.0)
    np.testing.assert_allclose(other.targets, turn.targets * mirror, atol=EXACT)
    np.testing.assert_allclose(other.out.energy[:, -1], turn.out.energy[:, -1], rtol=1e-9)
    seen = np.asarray(other.out.vertices) * mirror
    np.testing.assert_allclose(seen, turn.out.vertices, atol=1e-3)


@pytest.mark.slow
def test_frames_one_by_one_and_from_a_start(turn):
    problem, targets, rigidity, out = turn
    told = []
    tell = lambda *numbers: told.append(numbers)  # noqa: E731
    early = jd.deform_path(problem, targets[:3], rigidity, solver=TIGHT, progress=tell)
    assert told == [(1, 3), (2, 3), (3, 3)]
    np.testing.assert_allclose(early.energy[:, -1], out.energy[:3, -1], rtol=1e-9)
    assert early.steps.tolist() == out.steps[:3].tolist()
    late = jd.deform_path(
        problem, targets[-2:], rigidity, solver=TIGHT, start=out.vertices[-3], progress=tell
    )
    np.testing.assert_allclose(late.energy[:, -1], out.energy[-2:, -1], rtol=1e-9)


@pytest.mark.slow
def test_batches_and_a_frame_that_fails(bar, bar_problem):
    """Under jit and vmap; the frame behind one that fails starts from the last sound one."""
    points = bar.vertices[bar_problem.handles]
    steps = np.stack([jd.bend(points, a) for a in (20.0, 40.0, 60.0)])
    broken = steps.copy()
    broken[1, 7] = np.nan  # only a traced one can be: known ones are refused
    rigidity = np.array([0.1, 10.0, 10.0])

    @jax.jit
    @jax.vmap
    def batch(targets, r):
        return jd.deform_path(bar_problem, targets, r)

    out = batch(np.stack([steps, steps, broken]), rigidity)
    assert out.vertices.shape == (3, 3, 722, 3)
    for member, k in np.ndindex(2, 3):
        # Up to here a bend has one minimum, so that any start finds it (to 1e-8 of its energy).
        alone = jd.deform(bar_problem, steps[k], rigidity[member])
        np.testing.assert_allclose(out.energy[member, k, -1], alone.energy[-1], rtol=1e-6)
        np.testing.assert_allclose(out.vertices[member, k], alone.vertices, atol=3e-2)
    assert out.ok.tolist() == [[True] * 3, [True] * 3, [True, False, True]]
    assert bool((out.result == jd.Result.bad_input)[2, 1])
    assert not np.isfinite(out.vertices[2, 1]).all()
    np.testing.assert_allclose(out.energy[2, 2, -1], out.energy[1, 2, -1], rtol=1e-6)


WRONG = {
    "targets have shape (146, 3): give (frames, 146, 3), the targets of each frame": lambda t: t[0],
    "targets have shape (0, 146, 3)": lambda t: t[:0],
    "targets have shape (24, 145, 3)": lambda t: t[:, :-1],
    "targets of frame 3 are not finite": lambda t: np.where(
        np.arange(24)[:, None, None] == 3, np.inf, t
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_targets_are_named(turn, message):
    with pytest.raises(jd.InputError) as caught:
        jd.deform_path(turn.problem, WRONG[message](turn.targets), 1.0)
    assert str(caught.value).startswith(message)


def test_progress_is_refused_while_jax_traces(turn):
    with pytest.raises(jd.InputError, match="progress is told while the frames are computed"):
        jax.jit(lambda t: jd.deform_path(turn.problem, t, 1.0, progress=print))(turn.targets)


# ---------------------------------------------------------------- slow


CASES = {
    # mesh, how much longer, rings, degrees; the bar of the thesis itself slips at 390 degrees
    "bar 180": ("bar", 1, 1, 180),
    "long bar 720": ("bar", 2, 1, 720),
    "cylinder 360": ("cylinder", 1, 4, 360),
    "long cylinder 720": ("cylinder", 2, 4, 720),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_turns_of_what_resists(name):
    shape, longer, rings, degrees = CASES[name]
    mesh = getattr(jd.shapes, shape)()
    mesh = jd.Mesh(mesh.vertices * [1, longer, 1], mesh.faces)
    problem = jd.precompute(mesh, ends(mesh), cells=jd.rings(mesh, rings))
    rigidity = jd.rigidity_from_material(problem, 10.0)
    out = jd.deform_path(problem, twists(mesh, problem, degrees, degrees // 10), rigidity)
    assert np.all(out.ok)
    assert not np.any(out.flipped)
    assert np.all(np.diff(out.energy[:, -1]) > 0)
    if degrees % 360 == 0:
        width = np.ptp(mesh.vertices[:, 0])
        assert np.abs(np.asarray(out.vertices[-1]) - mesh.vertices).max() > 0.1 * width


@pytest.mark.slow
@pytest.mark.parametrize("frames", [36, 72])
def test_what_does_not_resist_passes_through_itself(bar, bar_problem, frames):
    """A surface has no inside: the soft bar slips by a full turn, and the frames tell of it."""
    rigidity = jd.rigidity_from_material(bar_problem, 0.2)
    out = jd.deform_path(bar_problem, twists(bar, bar_problem, 360.0, frames), rigidity)
    energy = np.asarray(out.energy)[:, -1]
    assert np.all(out.ok)
    assert np.all(np.diff(energy[: frames // 2]) > 0)
    assert energy.argmax() < frames - 1
    assert np.any(out.jumped)
    np.testing.assert_allclose(out.vertices[-1], bar.vertices, atol=1e-2)


def difference(loss, at, along):
    h = 1e-4
    return (float(loss(at + h * along)) - float(loss(at - h * along))) / (2 * h)


@pytest.mark.slow
def test_derivatives_are_those_of_each_frame(bar, bar_problem):
    random = np.random.default_rng(0)
    targets = twists(bar, bar_problem, 120.0, 2)
    rigidity = random.uniform(1.0, 3.0, 722)
    pull = random.normal(size=(2, 722, 3))

    def loss(targets, rigidity, frames=slice(None)):
        out = jd.deform_path(bar_problem, targets, rigidity, solver=TIGHT)
        return jnp.sum((out.vertices * pull)[frames])

    slope, felt = jax.grad(loss, (0, 1))(jnp.asarray(targets), jnp.asarray(rigidity))
    along, other = random.normal(size=targets.shape), random.normal(size=722)
    want = difference(lambda t: loss(t, rigidity), targets, along)
    assert abs(float(jnp.sum(slope * along)) / want - 1) < FD
    want = difference(lambda r: loss(targets, r), rigidity, other)
    assert abs(float(jnp.sum(felt * other)) / want - 1) < FD
    # A frame's minimum does not move with the targets of another.
    first = along * np.array([1.0, 0.0])[:, None, None]
    moved = difference(lambda t: loss(t, rigidity, frames=1), targets, first)
    assert abs(moved) < FD * np.abs(np.sum(np.asarray(slope)[1] * along[1]))
    want = difference(lambda t: loss(t, rigidity, frames=0), targets, first)
    assert abs(float(np.sum(np.asarray(slope)[0] * along[0])) / want - 1) < FD


@pytest.mark.slow
def test_forward_mode_unrolled_steps_and_errors(bar, bar_problem):
    random = np.random.default_rng(1)
    targets = twists(bar, bar_problem, 60.0, 2)
    along, pull = random.normal(size=targets.shape), random.normal(size=(722, 3))

    def loss(t, solver):
        return jnp.sum(jd.deform_path(bar_problem, t, 1.0, solver=solver).vertices[-1] * pull)

    for solver in (replace(TIGHT, leave_saddles=False), TWENTY):
        want = difference(lambda t, s=solver: loss(t, s), targets, along)
        _, slope = jax.jvp(lambda t, s=solver: loss(t, s), (targets,), (along,))
        assert abs(float(slope) / want - 1) < FD
        back = jax.grad(loss)(jnp.asarray(targets), solver)
        assert abs(float(jnp.sum(back * along)) / want - 1) < FD
        # Twenty steps have not forgotten where they started; a minimum has.
        assert bool(np.any(np.asarray(back[0]))) == (solver is TWENTY)
    hasty = jd.QuasiNewton(max_steps=1)
    out = jd.deform_path(bar_problem, targets, 1.0, solver=hasty)
    assert not np.any(out.ok)
    with pytest.raises(Exception, match="Stopped at the step limit"):
        jd.deform_path(bar_problem, targets, 1.0, solver=hasty, throw=True)


@pytest.mark.slow
def test_normals_soft_handles_and_single_precision(bar):
    soft = jd.precompute(bar, ends(bar), handle_weights=10.0)
    targets = twists(bar, soft, 40.0, 2)
    out = jd.deform_path(soft, targets, 1.0, solver=TIGHT)
    alone = jd.deform(soft, targets[1], 1.0, solver=TIGHT)
    np.testing.assert_allclose(out.energy[1, -1], alone.energy[-1], rtol=1e-9)
    thesis = jd.deform_path(soft, targets, 1.0, normals=True)
    assert thesis.energy.shape == (2, 101)
    assert np.all(thesis.ok)
    low = jd.precompute(bar, ends(bar), dtype=np.float32)
    single = jd.deform_path(low, [jnp.asarray(t, jnp.float32) for t in targets], 1.0)
    assert single.vertices.dtype == jnp.float32
    hard = jd.deform(jd.precompute(bar, ends(bar)), targets[1], 1.0, solver=TIGHT)
    assert relative(single.vertices[1], hard.vertices) < 1e-3
