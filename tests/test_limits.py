"""Numerical edges, as docs/limits.md lists them: right, or a result that says why not."""

import jax
import numpy as np
import pytest

import jaxdeform as jd

pytestmark = pytest.mark.slow
TYPES = [np.float64, np.float32]


@pytest.fixture(scope="module")
def handles(bar_problem) -> np.ndarray:
    return bar_problem.handles


@pytest.fixture(scope="module")
def unit(bar_problem) -> float:
    """Return the rigidity of a constant of 1: the mean area of a cell."""
    return float(np.mean(np.asarray(jd.rigidity_from_material(bar_problem, 1.0))))


def deformed(vertices, faces, handles, targets, rigidity, dtype, **settings) -> jd.Solution:
    """Deform, and check what holds for every end: the energy falls, and 'ok' is finite."""
    mesh = jd.Mesh(vertices, faces)
    with jax.enable_x64(dtype == np.float64):
        problem = jd.precompute(mesh, handles, **settings)
        out = jd.deform(problem, targets, rigidity)
    assert problem.dtype == dtype
    energy = np.asarray(out.energy, np.float64)[: int(out.steps) + 1]
    if bool(out.ok):
        assert np.isfinite(np.asarray(out.vertices)).all()
        rounding = 1e-12 if dtype == np.float64 else 1e-4
        assert (np.diff(energy) <= rounding * energy[0] + 1e-300).all()
    return out


def relative(a, b, size) -> float:
    return float(np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)).max() / size)


@pytest.fixture(scope="module")
def usual(bar, handles, bar_targets, unit) -> jd.Solution:
    return deformed(bar.vertices, bar.faces, handles, bar_targets, unit, np.float64)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e4, 1e9])
def test_any_unit_of_length(bar, handles, bar_targets, unit, usual, scale, dtype):
    v = bar.vertices * scale
    out = deformed(v, bar.faces, handles, bar_targets * scale, unit * scale**2, dtype)
    # A descent stops at 1e-8 of the energy: where rounding differs, 1e-4 of the shape.
    near = 1e-4 if dtype == np.float64 else 2e-3
    assert bool(out.ok)
    got = np.asarray(out.vertices, np.float64) / scale
    assert relative(got, usual.vertices, bar.diagonal) < near


def test_far_from_the_origin(bar, handles, bar_targets, unit, usual):
    """A million diagonals: of sixteen digits, ten are left."""
    shift = 1e6 * bar.diagonal * np.array([1.0, -2.0, 0.5])
    out = deformed(bar.vertices + shift, bar.faces, handles, bar_targets + shift, unit, np.float64)
    assert relative(np.asarray(out.vertices) - shift, usual.vertices, bar.diagonal) < 1e-6


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("factor", [0.0, 1e-12, 1e-6, 1e6, 1e12])
def test_any_rigidity(bar, handles, bar_targets, unit, factor, dtype):
    out = deformed(bar.vertices, bar.faces, handles, bar_targets, unit * factor, dtype)
    assert bool(out.ok)
    if factor == 1e12:  # rigid to rounding: the cells only turn
        t = np.asarray(out.transforms, np.float64)
        strain = np.abs(np.einsum("kia,kib->kab", t, t) - np.eye(3))
        assert np.median(strain) < (1e-9 if dtype == np.float64 else 1e-3)


@pytest.mark.parametrize("dtype", TYPES)
def test_rubber_beside_steel(bar, handles, bar_targets, unit, dtype):
    lower = bar.vertices[:, 1] < 75
    mixed = np.where(lower, 1e-12, 1e12) * unit
    assert bool(deformed(bar.vertices, bar.faces, handles, bar_targets, mixed, dtype).ok)


def both(vertices, faces, handles, targets, rigidity, may_stop=False) -> jd.Solution:
    """Deform in both precisions, which converge to the same energy.

    Or, if it may stop, float32 ends higher, or tells of a saddle: without FMA, of three orders of
    mixed targets one ends at a saddle 2.5e-4 higher, another 1.8e-4 higher.
    """
    out, single = (deformed(vertices, faces, handles, targets, rigidity, dtype) for dtype in TYPES)
    assert bool(out.ok)
    at_saddle = may_stop and bool(single.result == jd.Result.saddle)
    assert at_saddle or bool(single.ok)
    np.testing.assert_allclose(single.energy[-1], out.energy[-1], rtol=1e-3 if may_stop else 1e-4)
    # Another shape, of the crumpled ones: 12 cells inside out instead of 11.
    assert may_stop or int(single.flipped) == int(out.flipped)
    return out


@pytest.mark.parametrize("squeeze", [1e-2, 1e-4])
def test_needles(bar, handles, bar_targets, unit, squeeze):
    """Angles down to 0.006 degrees, by making the bar flat in one direction."""
    flat = np.array([1.0, squeeze, 1.0])
    out = both(bar.vertices * flat, bar.faces, handles, bar_targets * flat, unit)
    assert int(out.flipped) == 0


@pytest.mark.parametrize(
    ("where", "inside_out"),
    [("in one point", False), ("mirrored", True), ("100 diagonals away", False), ("mixed", True)],
)
def test_targets_that_no_shape_can_like(bar, handles, bar_targets, unit, where, inside_out):
    at = {
        "in one point": np.zeros_like(bar_targets),
        "mirrored": bar_targets * [-1.0, 1.0, 1.0],
        "100 diagonals away": bar_targets * 100.0,
        "mixed": np.random.default_rng(0).permutation(bar_targets),
    }[where]
    out = both(bar.vertices, bar.faces, handles, at, unit, may_stop=where == "mixed")
    np.testing.assert_allclose(np.asarray(out.vertices)[handles], at, atol=1e-9 * bar.diagonal)
    assert (int(out.flipped) > 0) == inside_out


@pytest.mark.parametrize("r", [2, 3, 4, 5])
def test_large_cells(bar, handles, bar_targets, unit, r):
    cells = jd.rings(bar, r)
    out = deformed(bar.vertices, bar.faces, handles, bar_targets, unit, np.float64, cells=cells)
    assert bool(out.ok)
    alone = jd.deform(
        jd.precompute(bar, handles, cells=cells), bar_targets, unit, solver=jd.Alternating(400)
    )
    assert float(out.energy[-1]) <= float(alone.energy[-1]) * (1 + 1e-6)
