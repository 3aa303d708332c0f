"""A problem is a value; what is put together from two is refused."""

import copy
import pickle

import equinox as eqx
import numpy as np
import pytest
from helpers import ends

import jaxdeform as jd


def test_a_copy_deforms_as_the_problem_does(bar_problem, bar_targets):
    want = jd.deform(bar_problem, bar_targets, 1.0)
    for one in (copy.deepcopy(bar_problem), pickle.loads(pickle.dumps(bar_problem))):
        assert one.cells == bar_problem.cells
        np.testing.assert_array_equal(jd.deform(one, bar_targets, 1.0).vertices, want.vertices)


def other_meshes(bar):
    """Two problems whose arrays have the shapes of the bar's."""
    longer = jd.Mesh(bar.vertices * [1.0, 2.0, 1.0], bar.faces)
    weights = jd.cotangent_weights(bar) + 1.0
    return {
        "another mesh": jd.precompute(longer, ends(longer)),
        "other cells": jd.precompute(bar, ends(bar), cells=jd.rings(bar, weights=weights)),
    }


@pytest.mark.parametrize("other", ["another mesh", "other cells"])
def test_arrays_of_another_problem_are_refused(bar, bar_problem, bar_targets, other, tmp_path):
    file = tmp_path / "problem.eqx"
    eqx.tree_serialise_leaves(file, bar_problem)
    mixed = eqx.tree_deserialise_leaves(file, other_meshes(bar)[other])
    with pytest.raises(jd.InputError, match="arrays are of another mesh, or of other cells"):
        jd.deform(mixed, bar_targets, 1.0)
    same = eqx.tree_deserialise_leaves(file, jd.precompute(bar, ends(bar)))
    assert jd.deform(same, bar_targets, 1.0).ok
