"""Makers of targets against SciPy's rotations, in NumPy and in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, ends
from scipy.spatial.transform import Rotation

import jaxdeform as jd

POINTS = np.random.default_rng(0).normal(size=(12, 3))
CENTER = np.array([0.3, -2.0, 1.0])


@pytest.mark.parametrize(
    ("axis", "vector"), [("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1]), ([1, -2, 0.5],) * 2]
)
@pytest.mark.parametrize("degrees", [0.0, 37.0, -180.0, 720.0])
def test_rotate_is_scipys(axis, vector, degrees):
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array(vector) / np.linalg.norm(vector))
    found = jd.rotate(POINTS, degrees, axis=axis, center=CENTER)
    np.testing.assert_allclose(found, turn.apply(POINTS - CENTER) + CENTER, atol=EXACT)
    middle = POINTS.mean(axis=0)
    found = jd.rotate(POINTS, degrees, axis=axis)
    np.testing.assert_allclose(found, turn.apply(POINTS - middle) + middle, atol=EXACT)


def test_translate():
    np.testing.assert_allclose(jd.translate(POINTS, CENTER), POINTS + CENTER, atol=EXACT)
    np.testing.assert_allclose(jd.translate(POINTS, POINTS), 2 * POINTS, atol=EXACT)


@pytest.mark.parametrize("along", ["x", "y", "z"])
def test_bend_and_twist_are_scipys(along):
    axis = "xyz".index(along)
    height = POINTS[:, axis]
    upper = height > (height.min() + height.max()) / 2
    assert 0 < upper.sum() < 12
    toward = "yzx"[axis]
    # From along to toward is a turn about their cross product.
    normal = np.cross(np.eye(3)[axis], np.eye(3)[(axis + 1) % 3])
    for found, direction, middle in (
        (
            jd.bend(POINTS, 50.0, along=along, toward=toward),
            normal,
            (POINTS.min(axis=0) + POINTS.max(axis=0)) / 2,
        ),
        (jd.twist(POINTS, 50.0, along=along), np.eye(3)[axis], POINTS.mean(axis=0)),
    ):
        turn = Rotation.from_rotvec(np.radians(50.0) * direction)
        want = np.where(upper[:, None], turn.apply(POINTS - middle) + middle, POINTS)
        np.testing.assert_allclose(found, want, atol=EXACT)


def test_bent_bar_ends_lie_as_in_the_thesis(bar):
    """One end stays, the other's outward normal turns from +y to +x."""
    handles = ends(bar)
    moved = np.asarray(jd.bend(bar.vertices[handles], 90.0))
    low = bar.vertices[handles][:, 1] < 75
    np.testing.assert_array_equal(moved[low], bar.vertices[handles][low])
    x, y = moved[~low, 0], moved[~low, 1]
    top = bar.vertices[handles][~low, 1]
    np.testing.assert_allclose(x, top - 75.5, atol=EXACT)
    np.testing.assert_allclose(y, 75.5 - bar.vertices[handles][~low, 0], atol=EXACT)


@pytest.mark.parametrize("motion", [jd.bend, jd.twist, jd.rotate])
def test_motions_differentiate_and_compile(motion):
    weight = jnp.asarray(np.random.default_rng(1).normal(size=POINTS.shape))
    f = jax.jit(lambda points, degrees: jnp.sum(weight * motion(points, degrees)))
    points, direction = jnp.asarray(POINTS), jnp.asarray(POINTS[::-1])
    for degrees in (0.0, 70.0):
        slope, turn = jax.grad(f, argnums=(0, 1))(points, degrees)
        h = 1e-6
        want = (f(points, degrees + h) - f(points, degrees - h)) / (2 * h)
        np.testing.assert_allclose(turn, want, rtol=FD)
        upper, lower = (f(points + s * h * direction, degrees) for s in (1, -1))
        want = (upper - lower) / (2 * h)
        np.testing.assert_allclose(jnp.sum(slope * direction), want, rtol=FD)


def test_single_precision_stays_single_and_integers_become_floats():
    low = jnp.asarray(POINTS, jnp.float32)
    for found in (jd.rotate(low, 9.0), jd.bend(low), jd.twist(low), jd.translate(low, [1, 2, 3])):
        assert found.dtype == jnp.float32
    assert jd.rotate([[1, 0, 0], [0, 1, 0]], 90).dtype == jnp.float64


MOTIONS = {
    "translate": lambda points: jd.translate(points, CENTER),
    "rotate": lambda points: jd.rotate(points, 33.0, axis=[1, -2, 0.5]),
    "rotate about": lambda points: jd.rotate(points, 33.0, axis="x", center=CENTER),
    "twist": lambda points: jd.twist(points, -50.0, along="z"),
    "bend": lambda points: jd.bend(points, 120.0, along="x", toward="z"),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_numpy_and_jax_give_the_same_in_their_own_arrays(name):
    host, device = MOTIONS[name](POINTS), MOTIONS[name](jnp.asarray(POINTS))
    assert isinstance(host, np.ndarray)
    assert isinstance(device, jax.Array)
    assert isinstance(MOTIONS[name](POINTS.tolist()), np.ndarray)
    np.testing.assert_allclose(host, device, atol=1e-12)
    low = MOTIONS[name](POINTS.astype(np.float32))
    assert low.dtype == np.float32
    np.testing.assert_allclose(low, host, atol=1e-5)  # 100 eps


def test_a_jax_motion_makes_the_result_jaxs():
    angle = jnp.asarray(9.0)
    for found in (
        jd.rotate(POINTS, angle),
        jd.bend(POINTS, angle),
        jd.twist(POINTS, angle),
        jd.translate(POINTS, jnp.asarray(CENTER)),
        jd.rotate(POINTS, 9.0, center=jnp.asarray(CENTER)),
    ):
        assert isinstance(found, jax.Array)


@pytest.mark.parametrize("kind", [">f8", ">f4", np.longdouble, np.float16, np.int8, np.uint64])
def test_every_type_of_number_is_taken(kind):
    whole = np.round(POINTS + 5)
    found = jd.bend(whole.astype(kind), 90.0)
    assert found.dtype in (np.float32, np.float64)
    assert found.dtype.isnative
    np.testing.assert_allclose(found, jd.bend(whole, 90.0), atol=1e-5)


@pytest.mark.parametrize("size", [1e308, 1e-200, 5e-324])
def test_an_axis_may_have_any_length(size):
    want = Rotation.from_rotvec(np.radians(77.0) * np.array([1, 1, 0]) / np.sqrt(2))
    for points in (POINTS, jnp.asarray(POINTS)):
        found = jd.rotate(points, 77.0, axis=[size, size, 0], center=np.zeros(3))
        np.testing.assert_allclose(found, want.apply(POINTS), atol=EXACT)


def test_whole_turns_change_nothing():
    for points in (POINTS, jnp.asarray(POINTS)):
        found = jd.rotate(points, 360.0 * 1e6 + 90.0)
        np.testing.assert_allclose(found, jd.rotate(POINTS, 90.0), atol=EXACT)


def test_bend_along_a_vector_is_the_bend_of_rotated_points():
    turn = Rotation.from_rotvec([0.3, -0.8, 1.1])
    # Two points, so that the middle of their extent does not depend on the frame.
    points = np.array([[0.2, -3.0, 0.1], [-0.4, 2.0, 0.7]])
    along, toward = turn.apply([0, 2.0, 0]), turn.apply([3.0, 0, 0])
    found = jd.bend(turn.apply(points), 40.0, along=along, toward=toward)
    np.testing.assert_allclose(found, turn.apply(jd.bend(points, 40.0)), atol=EXACT)


def test_bad_arguments_are_named():
    bad = {
        r"points have shape \(3,\)": lambda: jd.rotate([1.0, 2, 3], 9.0),
        r"points have shape \(0, 3\)": lambda: jd.bend(np.zeros((0, 3))),
        "points cannot be read as numbers: it is text": lambda: jd.twist([["a", "b", "c"]]),
        "axis is 'w': give": lambda: jd.rotate(POINTS, 9.0, axis="w"),
        "along is 'xy': give": lambda: jd.twist(POINTS, along="xy"),
        r"axis is \[0, 0, 0\]": lambda: jd.rotate(POINTS, 9.0, axis=[0, 0, 0]),
        r"axis is \[nan": lambda: jd.rotate(POINTS, 9.0, axis=[np.nan, 0, 0]),
        "along is 'z' and toward 'z'": lambda: jd.bend(POINTS, along="z", toward="z"),
        r"center has shape \(2,\): give \(3,\)": lambda: jd.rotate(POINTS, 9.0, center=[0.0, 1.0]),
        r"degrees has shape \(2,\)": lambda: jd.bend(POINTS, [9.0, 8.0]),
        r"axis is \[inf": lambda: jd.rotate(POINTS, 9.0, axis=[np.inf, 0, 0]),
        "axis cannot be read as numbers: it is None": lambda: jd.rotate(POINTS, 9.0, axis=None),
        r"axis is \[1, 2\]": lambda: jd.rotate(POINTS, 9.0, axis=[1, 2]),
        "degrees cannot be read": lambda: jd.rotate(POINTS, "many"),
        "axis: traced by JAX": lambda: jax.jit(lambda a: jd.rotate(POINTS, 9.0, axis=a))(CENTER),
        "degrees is 1e\\+300": lambda: jd.bend(POINTS, 1e300),
        "degrees is nan": lambda: jd.twist(jnp.asarray(POINTS), np.nan),
        "degrees cannot be read as numbers: it is None": lambda: jd.twist(POINTS, None),
        "points cannot be read": lambda: jd.twist([[1.0, 2.0], [1.0]]),
        r"point 1 is \[0.0, nan, 0.0\]": lambda: jd.bend([[0, 0, 0], [0, np.nan, 0]]),
        r"point 0 is \[inf": lambda: jd.bend(jnp.full((2, 3), np.inf)),
        "points overflow": lambda: jd.translate([[1e308, 0, 0]], [1e308, 0, 0]),
        "moved points overflow": lambda: jd.twist([[1e308, 0, 0], [1e308, 1e308, 0]]),
        r"offset is \[nan": lambda: jd.translate(POINTS, [np.nan, 0, 0]),
        "center is": lambda: jd.rotate(POINTS, 9.0, center=[np.inf, 0, 0]),
        r"offset has shape \(2,\): give \(3,\) or \(12, 3\)": lambda: jd.translate(POINTS, [1, 2]),
    }
    for message, call in bad.items():
        with pytest.raises(jd.InputError, match=message):
            call()
