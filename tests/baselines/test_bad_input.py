"""Bad input of the baselines gets a clear error."""

import numpy as np
import pytest
from helpers import BLENDS, CUBE, random_skin

import jaxdeform as jd


def bad_calls():
    vertices, weights, moves = random_skin()
    stretched = moves.copy()
    stretched[2, :, :3] *= 1.01
    mirrored = moves.copy()
    mirrored[1, :, :3] *= -1
    heavy = weights.copy()
    heavy[7] *= 1.1
    negative = weights.copy()
    negative[3] = [1.5, -0.5, 0, 0]
    nan = vertices.copy()
    nan[4, 1] = np.nan
    bones = np.ones((2, 2, 3))
    bones[0, 1] = 0
    fan = jd.Mesh(np.eye(5, 3) + 0.1, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    square = jd.shapes.square()
    # Two sheets that share one corner.
    aside = square.vertices + np.array([2.0, 2.0, 0.0])
    touching = jd.Mesh(
        np.concatenate([square.vertices, aside[1:]]),
        np.concatenate([square.faces, square.faces + 8]),
    )
    loose = jd.Mesh(np.concatenate([square.vertices, [[9, 9, 9]]]), square.faces)
    two = jd.Mesh(
        np.concatenate([square.vertices, square.vertices + 9]),
        np.concatenate([square.faces, square.faces + 9]),
    )
    far = np.full((40, 3), np.inf)
    lbs, dqs = BLENDS
    idw, bbw, mvc = (
        jd.inverse_distance_weights,
        jd.bounded_biharmonic_weights,
        jd.mean_value_coordinates,
    )
    return {
        "weights of vertex 7 sum to 1.1": lambda: lbs(vertices, heavy, moves),
        r"weights have shape \(39, 4\)": lambda: lbs(vertices, weights[1:], moves),
        "transforms have shape": lambda: lbs(vertices, weights, moves[:3]),
        "transforms cannot be read": lambda: lbs(vertices, weights, "north"),
        "vertices of vertex 4 are not finite": lambda: dqs(nan, weights, moves),
        "vertices have shape": lambda: dqs(vertices[:, :2], weights, moves),
        "a weight of vertex 3 is -0.5": lambda: dqs(vertices, negative, moves),
        "the matrix of control 2 is not a rotation": lambda: dqs(vertices, weights, stretched),
        "the matrix of control 1 is not a rotation": lambda: dqs(vertices, weights, mirrored),
        "rotations have shape": lambda: jd.rigid_transforms([0, 0, 1], [0, 0, 0], [0, 0, 0]),
        "centers have shape": lambda: jd.rigid_transforms([[0, 0, 1]], [[0, 0, 0]], [0, 0, 0]),
        "bone 1 has length zero": lambda: idw(vertices, bones),
        "controls have shape": lambda: idw(vertices, bones[:, :, :2]),
        "controls of control 0 are not finite": lambda: idw(vertices, [[0, 0, np.inf]]),
        "power is 0": lambda: idw(vertices, [[0, 0, 0]], 0.0),
        "distances have shape": lambda: idw(vertices, np.eye(3), distances=np.ones((40, 2))),
        "vertex 0 is connected to no control": lambda: idw(vertices, np.eye(3), distances=far),
        "distance of vertex 0 to control 0 is -inf": lambda: jd.rigid_weights(
            vertices, np.eye(3), distances=-far
        ),
        "source 9 .*out of range": lambda: jd.geodesic_distances(square, [9]),
        "need a manifold surface": lambda: jd.geodesic_distances(fan, [0]),
        "distances need a manifold": lambda: jd.geodesic_distances(touching, [0]),
        "handle 99 .*out of range": lambda: bbw(square, [99]),
        "group 1 has no handles": lambda: bbw(square, [0, 8, 2], [0, 2, 2]),
        "the group of handle 1 is -1": lambda: bbw(square, [0, 8], [0, -1]),
        "group has shape": lambda: bbw(square, [0, 8], [0]),
        "vertex 9 belongs to no face": lambda: bbw(loose, [0]),
        "component with vertex 9 .*no handle": lambda: bbw(two, [0]),
        "the cage is open, .*edge": lambda: mvc(square.vertices, square),
        "oriented against each other, at the edge": lambda: mvc(
            [[0, 0, 0]], jd.Mesh(CUBE.vertices, [CUBE.faces[0][::-1], *CUBE.faces[1:]])
        ),
        r"vertex 1 \[0.0, 1.5, 0.0\] is outside": lambda: mvc([[0, 0, 0], [0, 1.5, 0]], CUBE),
        "vertices of vertex 0 are not finite": lambda: mvc([[0, 0, np.nan]], CUBE),
        "skeletons are .tgf files": lambda: jd.load_skeleton("bones.txt"),
        "cannot be read": lambda: jd.load_skeleton("nowhere.tgf"),
    }


@pytest.mark.parametrize("message", bad_calls())
def test_bad_input_gets_a_clear_error(message):
    with pytest.raises(jd.InputError, match=message) as caught:
        bad_calls()[message]()
    assert "\n" not in str(caught.value)
