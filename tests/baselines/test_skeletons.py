"""Skeleton files, whole and broken."""

import copy
import pickle

import numpy as np
import pytest

import jaxdeform as jd


def test_reading_a_skeleton(tmp_path):
    path = tmp_path / "hand.tgf"
    path.write_text(
        "1 0 0 0\n2 0 1 0\n\n3 0 2.5 1e-1\n4 9 9 9\n"
        "#\n1 2 1 0 0\n2 3\n3 4 0 0 1\n4 1 0 1 0\n#\n1 2 3\n"
    )
    skeleton = jd.load_skeleton(path)
    np.testing.assert_array_equal(skeleton.bones, [[0, 1], [1, 2]])  # no cage edge, no pseudo edge
    np.testing.assert_array_equal(skeleton.segments[1], [[0, 1, 0], [0, 2.5, 0.1]])
    assert "4 joints, 2 bones" in repr(skeleton)
    for one in (skeleton, pickle.loads(pickle.dumps(skeleton)), copy.deepcopy(skeleton)):
        np.testing.assert_array_equal(one.segments, skeleton.segments)
        for array in (one.joints, one.bones):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 5
    assert jd.inverse_distance_weights(np.ones((5, 3)), skeleton.segments).shape == (5, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("1 0 0 0\n2 1 1 1\n1 2\n", "line 3: expected joint 3"),
        ("1 0 0 0\n2 1 1 1\n#\n", "no bones"),
        ("1 0 0 0\n2 1 1 1_0\n#\n1 2\n", "line 2: '2 1 1 1_0' is not a joint"),
        ("1 0 0 0\n2 1 1 1\n#\n1 0_2\n", "line 4: '1 0_2' is not an edge"),
        ("1 0 0\n#\n", "line 1: expected joint 1"),
        ("1 0 0 nan\n#\n", "line 1: expected joint 1"),
        ("1 0 0 zero\n#\n", "line 1: '1 0 0 zero' is not a joint"),
        ("0 0 0 0\n#\n", "line 1: expected joint 1"),
        ("1 0 0 0\n2 1 1 1\n#\n1 3\n", "line 4: edge 1 3 names a joint out of range"),
        ("1 0 0 0\n2 1 1 1\n#\n0 1\n", "line 4: edge 0 1 names a joint out of range"),
        ("1 0 0 0\n2 1 1 1\n#\n1\n", "line 4: '1' is not an edge"),
        ("1 0 0 0\n2 1 1 1\n#\n1 a\n", "line 4: '1 a' is not an edge"),
        ("1 0 0 0\n2 0 0 0\n#\n1 2\n", "line 4: the bone from 1 to 2 has length zero"),
    ],
)
def test_broken_skeletons(tmp_path, text, message):
    path = tmp_path / "broken.tgf"
    path.write_text(text)
    with pytest.raises(jd.InputError, match=message) as caught:
        jd.load_skeleton(path)
    assert "broken.tgf" in str(caught.value)
    assert "\n" not in str(caught.value)
