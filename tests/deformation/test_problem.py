"""A problem is a value; what is put together from two is refused."""

import copy
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
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


@pytest.mark.parametrize("other", ["another mesh", "other cells"])
def test_inside_jit_arrays_of_another_problem_end_in_bad_input(
    bar, bar_problem, bar_targets, other, tmp_path
):
    """There they cannot be compared before the program runs."""
    file = tmp_path / "problem.eqx"
    eqx.tree_serialise_leaves(file, bar_problem)
    mixed = eqx.tree_deserialise_leaves(file, other_meshes(bar)[other])
    deform = jax.jit(lambda problem, targets: jd.deform(problem, targets, 1.0))
    out = deform(mixed, bar_targets)
    assert bool(out.result == jd.Result.bad_input)
    assert bool(deform(bar_problem, bar_targets).ok)
    stack = jax.tree.map(lambda *x: jnp.stack(x), mixed, mixed)
    both = jax.vmap(lambda problem: jd.deform(problem, bar_targets, 1.0))(stack)
    assert not both.ok.any()
    stack = jax.tree.map(lambda *x: jnp.stack(x), bar_problem, bar_problem)
    both = jax.vmap(lambda problem: jd.deform(problem, bar_targets, 1.0))(stack)
    assert both.ok.all()
    want = np.broadcast_to(jd.deform(bar_problem, bar_targets, 1.0).vertices, both.vertices.shape)
    np.testing.assert_allclose(both.vertices, want, atol=1e-9 * bar.diagonal)


def changed(bar, problem):
    """The bar's problem with parts of another one, or with other numbers."""
    handles = ends(bar)[::-1]
    turned = jd.precompute(bar, np.append(handles[1:], 300))
    twice = jax.tree.map(lambda x: 2 * x if jnp.issubdtype(x.dtype, jnp.floating) else x, problem)
    longer = other_meshes(bar)["another mesh"]
    return {
        "system": eqx.tree_at(lambda p: p.system, problem, turned.system),
        "factor": eqx.tree_at(lambda p: p.system.factor, problem, turned.system.factor),
        "factor of a mesh": eqx.tree_at(lambda p: p.system.factor, problem, longer.system.factor),
        "handles": eqx.tree_at(lambda p: p.handles, problem, np.array(handles)),
        "free": eqx.tree_at(lambda p: p.system.free, problem, ~problem.system.free),
        "center": eqx.tree_at(lambda p: p.system.center, problem, problem.system.center + 1.0),
        "all numbers": twice,
    }


def test_a_problem_that_was_changed_is_refused(bar, bar_targets):
    problem = jd.precompute(bar, ends(bar))
    for one in changed(bar, problem).values():
        with pytest.raises(jd.InputError, match=r"not those that precompute made together"):
            jd.deform(one, bar_targets, 1.0)


def test_what_is_left_of_a_problem_is_named(bar, bar_targets):
    problem = jd.precompute(bar, ends(bar))
    arrays, rest = eqx.partition(problem, eqx.is_inexact_array)
    for half in (arrays, rest, jax.eval_shape(lambda p: p, problem)):
        assert repr(half).startswith("Problem(")
        with pytest.raises(jd.InputError, match="where an array belongs: put its parts together"):
            jd.deform(half, bar_targets, 1.0)
    assert bool(jd.deform(eqx.combine(arrays, rest), bar_targets, 1.0).ok)
    jax.jit(lambda p: p.system.rest * 2, donate_argnums=0)(problem)
    with pytest.raises(jd.InputError, match="its arrays are deleted, as jit does"):
        jd.deform(problem, bar_targets, 1.0)


@pytest.mark.parametrize("damage", ["diagonal", "nan"])
def test_a_damaged_matrix_reaches_no_other_problem(bar, bar_targets, damage):
    """Factors are shared by the key of their content: nothing wrong may get there first."""
    # Handles and rigidities whose factors nothing else has made.
    handles, rigidity = np.append(ends(bar), 300), {"diagonal": 0.013, "nan": 0.017}[damage]
    targets = np.vstack([bar_targets, bar.vertices[300]])
    want = jd.deform(jd.precompute(bar, ends(bar)), bar_targets, rigidity)
    problem = jd.precompute(bar, handles)
    bits = np.array(problem.system.factor.values)
    values = bits.reshape(-1).view(np.float64)
    values[np.asarray(problem.system.factor.starts)[:-1]] *= 1e9 if damage == "diagonal" else np.nan
    bad = eqx.tree_at(lambda p: p.system.factor.values, problem, jnp.asarray(bits))
    with pytest.raises(Exception, match="do not belong together"):
        jd.deform(bad, targets, rigidity).vertices.block_until_ready()
    assert want.ok
    sound = jd.deform(problem, targets, rigidity)
    assert sound.ok
    assert float(sound.energy[-1]) >= float(want.energy[-1]) * (1 - 1e-9)  # one handle more
    assert bool(jd.is_minimum(problem, targets, rigidity, sound.vertices))
