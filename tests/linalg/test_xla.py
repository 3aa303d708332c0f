"""The compiler persuasions, in the optimised programs: each fails once XLA sees through it.

Where XLA does well without one, the test says so by a skip: that one may go.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeform._deformation.cell_newton import _diagonal_start
from jaxdeform._deformation.material_derivative import material_with_derivative
from jaxdeform._linalg.rotations import polar_rotation
from jaxdeform._linalg.small_matrices import as_grid
from jaxdeform._linalg.xla import AS_FAST, QUICK, _taken, after_reads, total, without_fusion


def compiled(function, *arguments) -> str:
    return jax.jit(function).lower(*arguments).compile().as_text()


def computations_with(text: str, operation: str) -> list[str]:
    """Return the computations of a compiled program that contain an operation."""
    return [part for part in text.split("\n\n") if f" {operation}(" in part]


def needed(it_is: bool) -> None:
    if not it_is:
        pytest.skip("this XLA needs no persuasion here")


@pytest.mark.parametrize("batch", [None, 4])
def test_total_keeps_the_expression_out_of_the_sum(batch):
    x = jnp.linspace(0.0, 1.0, 51_200)

    def plain(x):
        x = jnp.exp(x) * x
        return jnp.sum(x) if batch is None else jnp.sum(x.reshape(-1, batch), axis=0)

    def inside_the_sum(text):
        return any(" exponential(" in part for part in computations_with(text, "reduce"))

    def persuaded(x):
        return total(jnp.exp(x) * x, batch)

    np.testing.assert_allclose(persuaded(x), plain(x), rtol=1e-12)
    assert computations_with(compiled(persuaded, x), "exponential")
    assert not inside_the_sum(compiled(persuaded, x))
    needed(inside_the_sum(compiled(plain, x)))


def test_total_of_nan_is_nan():
    assert jnp.isnan(total(jnp.array([1.0, jnp.nan])))


def test_without_fusion_works_an_expression_out_once():
    """As in QuasiNewton: a masked sum, read by a stack, by inner products and by a selection."""
    rng = np.random.default_rng(0)
    terms = [jnp.asarray(rng.normal(size=(3, 5000, 4))) for _ in range(5)]

    def expression(terms):
        return jnp.where(terms[0] > 0, sum(jnp.abs(term) for term in terms), 0.0)

    def readers(x, old):
        both = jnp.moveaxis(jnp.stack([x - old, x]), -1, 0)
        products = jnp.einsum("bian,bjan->bij", both, both, precision="highest")
        return products, jnp.where(old > 0, x, old), both[:, 1] * 2.0

    def plain(terms, old, tick):
        return readers(expression(terms), old)

    def persuaded(terms, old, tick):
        return readers(without_fusion(tick >= 0, old, expression, terms), old)

    arguments = terms, terms[0], jnp.asarray(0, jnp.int32)
    for found, want in zip(persuaded(*arguments), plain(*arguments), strict=True):
        np.testing.assert_allclose(found, want, rtol=1e-12)
    times = {f: compiled(f, *arguments).count(" abs(") for f in (plain, persuaded)}
    assert times[persuaded] == len(terms)
    needed(times[plain] > len(terms))


def test_after_reads_lets_a_history_be_written_in_place():
    """As in QuasiNewton: a ring of vectors is read as a whole, then one slot of it replaced."""
    shape = (2, 4, 3, 5000)

    def loop(written):
        def body(state):
            tick, history, x = state
            reads = jnp.einsum("bsan,ban->bs", history, x, precision="highest")
            slot = tick % shape[1]
            kept = written(x[:, 0, 0] > 0, jnp.sum(reads, axis=1))[:, None, None]
            new = jnp.where(kept, 2.0 * x, history[:, slot])
            return tick + 1, history.at[:, slot].set(new), 0.5 * x + 1e-9 * jnp.sum(reads)

        start = jnp.asarray(0, jnp.int32), jnp.zeros(shape), jnp.ones(shape[:1] + shape[2:])
        return jax.lax.while_loop(lambda state: state[0] < 10, body, start)[1:]

    def copies(written):
        text = compiled(lambda: loop(written))
        array = re.escape(f"f64[{','.join(map(str, shape))}]")
        inside = [part for part in text.split("\n\n") if "ENTRY" not in part]
        return len(re.findall(rf"= {array}\S* copy\(", "\n".join(inside)))

    def plain(condition, reads):
        del reads
        return condition

    for found, want in zip(loop(after_reads), loop(plain), strict=True):
        np.testing.assert_allclose(found, want, rtol=1e-12)
    assert copies(after_reads) == 0
    needed(copies(plain) > 0)


def test_after_reads_refuses_what_is_not_finite():
    reads = jnp.array([1.0, jnp.nan, jnp.inf, 2.0])
    condition = jnp.array([True, True, True, False])
    np.testing.assert_array_equal(after_reads(condition, reads), [True, False, False, False])


def test_short_loops_stay_loops():
    """Unrolled, their steps would be repeated for each of the nine entries that follow."""
    c, b, lam = jnp.tile(jnp.eye(3)[..., None], 5), list(jnp.ones((3, 5))), jnp.ones(5)
    assert computations_with(compiled(polar_rotation, c), "while")
    start = lambda c, b, lam: _diagonal_start(as_grid(c), b, lam)  # noqa: E731
    assert computations_with(compiled(start, c, b, lam), "while")


@pytest.mark.parametrize("options", [AS_FAST, QUICK], ids=["as fast", "quick"])
def test_the_compiler_still_knows_the_options_of_quick_jit(options):
    """Without them programs are right, and compile for longer."""
    assert _taken(tuple(options.items())) == options


def test_the_solution_of_the_cells_is_worked_out_once():
    """It is read by the derivatives to C, b and lambda."""
    unit, ones = jnp.tile(jnp.eye(3)[..., None], 5), jnp.ones((3, 5))

    def pull_back(t, *at):
        return jax.vjp(lambda *x: material_with_derivative(t, *x), *at)[1](t)

    assert computations_with(compiled(pull_back, unit, unit, ones, ones[0]), "conditional")
