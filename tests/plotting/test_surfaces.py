"""Which way is up, where edges are sharp, how far a surface stretches, and the scale of colours."""

import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._plotting.camera import guess_up
from jaxdeform._plotting.color import RAMP, scale_of
from jaxdeform._plotting.surface import Surface


def cone() -> jd.Mesh:
    """A low cone, twice as wide as high: its foot says what is down, not its longest axis."""
    angle = np.arange(24) * np.pi / 12
    rim = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    points = np.concatenate([rim, [[0, 0, 0], [0, 1, 0]]])
    sides = [(k, (k + 1) % 24) for k in range(24)]
    return jd.Mesh(points, [f for i, j in sides for f in ((i, j, 24), (j, i, 25))])


@pytest.mark.parametrize("name", ["bar", "cactus", "cylinder", "cone"])
def test_up_turns_with_the_mesh(name):
    mesh = cone() if name == "cone" else getattr(jd.shapes, name)()
    for matrix in (
        np.eye(3),
        np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]),  # y to x
        np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),  # y to z
        np.diag([1, -1, -1]),  # on its head
    ):
        up = guess_up(jd.Mesh(mesh.vertices @ matrix.T, mesh.faces))
        want = matrix @ [0, 1, 0]
        assert abs(up @ want) == 1
        if name == "cone":
            np.testing.assert_array_equal(up, want)


@pytest.mark.parametrize(
    ("values", "log", "marks"),
    [
        ([0.01, 30.0], True, {0.01, 30.0, 0.1, 1.0}),
        ([1.0, 4.0], False, {1.0, 4.0, 2.0, 3.0}),
        ([-2.0, 6.0], False, {-2.0, 6.0, 0.0, 2.0, 4.0}),
        ([5.0, 5.0], False, {5.0}),
        ([-1e308, 1e308], False, {-1e308, 1e308}),
    ],
)
def test_marks_of_the_colour_bar(values, log, marks):
    scale = scale_of([np.array(values)])
    assert scale is not None
    assert scale.log == log
    found = scale.marks(0.1)
    assert marks <= {round(mark, 12) for mark in found} | set(found)
    assert np.isfinite(scale.place(np.array(found))).all()


def test_the_colour_map_is_even_and_light():
    """Lightness falls all the way, and no colour is dark."""
    linear = np.where(RAMP <= 0.04045, RAMP / 12.92, ((RAMP + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]  # of sRGB, from its standard
    assert np.all(np.diff(luminance) < 1e-3)
    assert luminance.min() > 0.2


def test_stretch_is_the_largest_singular_value(bar):
    stretch = Surface(bar).stretch
    np.testing.assert_allclose(stretch(bar.vertices), 1.0)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    np.testing.assert_allclose(stretch(2.5 * bar.vertices @ turn), 2.5)
    longer = stretch(bar.vertices * [1.0, 3.0, 1.0])
    side = (bar.vertices[:, 1] > 10) & (bar.vertices[:, 1] < 140)
    np.testing.assert_allclose(longer[side], 3.0)


def test_sharp_edges_stay_and_round_ones_vanish(bar):
    """A box has three points at each corner; a cactus has one at each vertex."""
    surface = Surface(bar)
    count = np.bincount(surface.index)
    corner = (np.abs(bar.vertices - bar.vertices.mean(axis=0)) > [14.9, 75.4, 14.9]).sum(axis=1)
    np.testing.assert_array_equal(count, np.maximum(corner, 1))
    normals = surface.normals(bar.vertices)
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0)
    round_ = jd.shapes.cactus()
    assert len(Surface(round_).index) < 1.01 * round_.n_vertices
