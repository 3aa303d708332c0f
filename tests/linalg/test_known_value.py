"""A value found by iterations has every derivative of the function that it is a value of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT

import jaxdeform as jd


def newton(root, x):
    return root - (root**2 - x) / (2.0 * root)


def found_root(x):
    """The square root, by iterations that nothing differentiates."""
    start = jax.lax.stop_gradient(x)
    root = jax.lax.while_loop(
        lambda r: jnp.abs(r * r - start) > 1e-15, lambda r: newton(r, start), 1.0 + start
    )

    def two_steps(x):
        return newton(newton(root, x), x)

    return jd.with_derivative_of(two_steps, root, x)


def in_a_scan(root, x):
    return jax.lax.scan(lambda y, _: (root(y) + x, None), x, None, length=3)[0]


FORWARD, REVERSE = jax.jacfwd, jax.jacrev


@pytest.mark.parametrize("place", ["alone", "in a scan"])
@pytest.mark.parametrize(
    "modes",
    [(a,) for a in (FORWARD, REVERSE)]
    + [(a, b) for a in (FORWARD, REVERSE) for b in (FORWARD, REVERSE)]
    + [(FORWARD, FORWARD, FORWARD), (FORWARD, FORWARD, REVERSE)],
    ids=lambda modes: " over ".join(mode.__name__ for mode in modes),
)
def test_derivatives_are_those_of_the_function(modes, place):
    def nested(function):
        for mode in reversed(modes):
            function = mode(function)
        return function

    if place == "alone":
        got, want = found_root, jnp.sqrt
    else:
        got, want = (lambda x, f=f: in_a_scan(f, x) for f in (found_root, jnp.sqrt))
    np.testing.assert_allclose(nested(got)(2.3), nested(want)(2.3), rtol=EXACT)


def test_the_value_is_the_known_one_and_the_function_is_not_run():
    run = jax.jit(lambda x: jd.with_derivative_of(jnp.sqrt, jnp.asarray(7.0), x)).lower(2.0)
    program = run.compile()
    assert float(program(2.0)) == 7.0
    assert "sqrt" not in program.as_text()


def test_misuse_is_named():
    one = jnp.ones(3)
    for text, call in {
        "function is a float: give what can be called": lambda: jd.with_derivative_of(1.0, one),
        "known is float64.3., but function returns float64.2.": lambda: jd.with_derivative_of(
            lambda: one[:2], one
        ),
        "known holds a str: give arrays of floating": lambda: jd.with_derivative_of(
            lambda: one, "one"
        ),
        "known is of int": lambda: jd.with_derivative_of(lambda: one, np.ones(3, int)),
        "known is .*, but function returns": lambda: jd.with_derivative_of(lambda: (one,), one),
        "the value of function holds a str": lambda: jd.with_derivative_of(lambda: "one", one),
    }.items():
        with pytest.raises(jd.InputError, match=text):
            call()
