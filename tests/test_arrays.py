"""Arrays of every form are read alike, and what JAX traces where JAX computes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from good_calls import SKIN, good_calls, kind_of
from helpers import EXACT

import jaxdeform as jd


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> dict:
    return good_calls(tmp_path_factory.mktemp("calls"))


QUICK = [
    *("Mesh", "bend", "energy", "find_handles", "inverse_distance_weights", "rigid_transforms"),
    *("linear_blend_skinning", "mean_value_coordinates", "rigid_targets", "rotate", "spokes"),
    *("rigidity_from_material", "submesh", "translate", "twist", "LaplacianEditor", "Submesh"),
]
OTHER_FORMS = {
    "other byte order": lambda x: x.astype(x.dtype.newbyteorder("S")),
    "long double": lambda x: x.astype(np.longdouble) if x.dtype.kind == "f" else x.astype("u1"),
    "columns first": lambda x: np.array(x, order="F"),
    "read-only": lambda x: np.broadcast_to(x, x.shape),
    "list": lambda x: x.tolist(),
    "JAX's": jnp.asarray,
    "list of JAX's": lambda x: list(jnp.asarray(x)) if x.ndim else x,
    "nothing masked": np.ma.masked_array,
}


def numbers_of(result) -> list[np.ndarray]:
    """Return all arrays in a result, which may be a mesh."""
    if isinstance(result, jd.Mesh):
        return [result.vertices, result.faces]
    if isinstance(result, jd.Cells):
        return [result.weights]
    if isinstance(result, jd.Submesh):
        return [result.index]
    return list(map(np.asarray, jax.tree.leaves(result)))


@pytest.mark.parametrize("function", QUICK)
def test_every_form_of_an_array_gives_the_same(calls, function):
    call, arguments = calls[function]
    want = numbers_of(call(**arguments))
    arrays = {
        name: np.asarray(value)
        for name, value in arguments.items()
        if kind_of(function, name) in ("numbers", "indices")
    }
    for what, form in OTHER_FORMS.items():
        got = numbers_of(call(**arguments | {name: form(x) for name, x in arrays.items()}))
        for a, b in zip(got, want, strict=True):
            np.testing.assert_allclose(a, b, rtol=EXACT, atol=EXACT, err_msg=what)


def test_a_list_may_hold_what_jax_traces():
    """As the rows of targets of which one is the unknown."""

    def height(angle):
        rows = [[1.0, 0.0, angle], [0.0, 1, 2.0]]
        return jnp.sum(jd.linear_blend_skinning(rows, np.full((2, 2), 0.5), SKIN["transforms"]))

    assert jax.jit(jax.grad(height))(0.3) == 1.0


@pytest.mark.parametrize(
    ("function", "argument"),
    [("Mesh", "vertices"), ("Mesh", "faces"), ("precompute", "handles"), ("submesh", "free")],
)
def test_what_numpy_works_out_cannot_be_traced(calls, function, argument):
    call, arguments = calls[function]
    given = jnp.asarray(arguments[argument])
    for traced in (given, list(given)):
        with pytest.raises(jd.InputError, match=rf"{argument}: traced by JAX .*known numbers"):
            jax.jit(lambda x: call(**arguments | {argument: x}))(traced)


@pytest.mark.parametrize("odd", [[True, 0], [0, np.True_], (1.5, False), [[0, 1, 2], [0, True, 3]]])
def test_booleans_among_numbers_are_refused(odd):
    """NumPy would take True for 1."""
    for call in (
        lambda: jd.precompute(jd.shapes.square(), odd),
        lambda: jd.rigid_targets(odd, [0, 0], np.zeros((1, 3)), np.zeros((1, 3))),
        lambda: jd.Mesh(np.eye(4)[:, :3], odd),
    ):
        with pytest.raises(jd.InputError, match="holds booleans among numbers: give numbers only"):
            call()
