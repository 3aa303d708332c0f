"""The materials of docs/derivatives.md are minima, and their derivatives are right."""

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EXACT, FD, held_sheet
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import jaxdeform as jd

PAGE = (Path(__file__).parents[1] / "docs" / "derivatives.md").read_text(encoding="utf-8")


def block(name: str, until: str | None = None) -> dict:
    """Run a block of the page, or its beginning, and return its names."""
    (code,) = re.findall(rf"<!-- {name} -->\n```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {"jax": jax, "jnp": jnp, "jd": jd, "__name__": name}
    exec(compile(code.split(until)[0] if until else code, name, "exec"), names)
    return names


@pytest.fixture(scope="module")
def cells():
    """C, the principal moments and the rigidity of a few cells that are turned and strained."""
    rng = np.random.default_rng(4)
    b = rng.uniform(0.2, 2.0, (3, 5))
    turned = Rotation.random(5, rng=4).as_matrix()
    strained = turned + 0.2 * rng.normal(size=(5, 3, 3))
    return jnp.asarray(np.einsum("ak,kca->ack", b, strained)), jnp.asarray(b), jnp.full(5, 0.7)


def corotated_price(x, c, b, rigidity):
    t = x.reshape(3, 3)
    u, s, vt = np.linalg.svd(t)
    s[2] *= np.sign(np.linalg.det(u @ vt))
    return rigidity * np.sum((s - 1) ** 2) + np.sum(t**2 * b) - 2 * np.sum(t * c.T)


def test_no_start_finds_less_than_the_corotated_minimum(cells):
    law = block("corotated", until="mesh =")["Corotated"]()
    found = np.asarray(law.minimize(*cells))
    rng = np.random.default_rng(5)
    for k in range(5):
        data = [np.asarray(x[..., k]) for x in cells]
        starts = rng.normal(size=(8, 9))
        best = min(minimize(corotated_price, start, tuple(data)).fun for start in starts)
        assert corotated_price(found[..., k], *data) <= best + 1e-9


@pytest.mark.slow
def test_derivatives_of_the_corotated_minimum(cells):
    """First and second ones, along a line through C, B and the rigidity."""
    law = block("corotated", until="mesh =")["Corotated"]()
    rng = np.random.default_rng(6)
    line = [jnp.asarray(0.1 * rng.normal(size=x.shape)) for x in cells]

    def at(s):
        return [x + s * d for x, d in zip(cells, line, strict=True)]

    def t(s):
        return law.with_implicit_derivative(law.minimize(*at(0.0)), *at(s))

    slope = jax.jacfwd(t)(0.0)
    difference = (law.minimize(*at(1e-5)) - law.minimize(*at(-1e-5))) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=FD, atol=FD * float(jnp.abs(slope).max()))

    def value(s):
        known = jax.lax.stop_gradient(law.minimize(*at(s)))
        return law.with_implicit_derivative(known, *at(s))

    curvature = jax.jacfwd(jax.jacfwd(value))(0.0)
    difference = (jax.jacfwd(value)(1e-5) - jax.jacfwd(value)(-1e-5)) / 2e-5
    scale = float(jnp.abs(curvature).max())
    np.testing.assert_allclose(curvature, difference, rtol=FD, atol=FD * scale)


def laws() -> dict:
    """Return, for each law of the page: how it is solved, and what gives that the derivatives."""
    volume = block("volume")
    price = volume["price"]

    def solve(c, b, rigidity):
        t = jd.RotationFit().minimize(c, b, rigidity)
        return jax.lax.fori_loop(0, 30, lambda _, t: newton(price, t, c, b, rigidity), t)

    corotated = block("corotated", until="mesh =")["Corotated"]()
    return {
        "corotated": (corotated.minimize, corotated.with_implicit_derivative),
        "volume": (solve, partial(volume["known_minimum_of"], price)),
    }


def newton(price, t, *data):
    """Take one step of Newton's method in every cell."""
    slope = jax.grad(price)

    def one_cell(t, *data):
        hessian = jax.jacfwd(slope)(t, *data).reshape(9, 9)
        return t - jnp.linalg.solve(hessian, slope(t, *data).reshape(9)).reshape(3, 3)

    return jax.vmap(one_cell, in_axes=-1, out_axes=-1)(t, *data)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["corotated", "volume"])
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_in_a_scan(cells, law, outer, inner):
    """Each step fits T to the C that the T of before makes, as an iteration does."""
    minimize, known = laws()[law]
    _, b, rigidity = cells

    def ends(x):
        def step(c, _):
            data = c * (1.0 + x), b, rigidity * jnp.exp(x)
            t = known(minimize(*map(jax.lax.stop_gradient, data)), *data)
            return jnp.swapaxes(t, 0, 1) * b[:, None], None

        return jnp.sum(jnp.sin(jax.lax.scan(step, cells[0], None, length=2)[0]))

    got = jax.jit(outer(inner(ends)))(0.1)
    slope = jax.jit(jax.jacfwd(ends))
    np.testing.assert_allclose(got, (slope(0.1 + 1e-5) - slope(0.1 - 1e-5)) / 2e-5, rtol=FD)


@pytest.mark.slow
def test_the_general_rule_agrees_with_the_one_of_newton(cells):
    """Without the term of volume its material is that of Newton()."""
    names = block("volume")

    def price(t, c, b, rigidity):
        return names["price"](t, c, b, rigidity, bulk=0.0)

    # To the last digit: a derivative of two Newton steps notices what is left of the gradient.
    t = newton(price, jd.Newton().minimize(*cells), *cells)
    changes = (jnp.zeros_like(t), *(jnp.ones_like(x) for x in cells))
    general = lambda *data: names["known_minimum_of"](price, *data)  # noqa: E731
    _, one = jax.jvp(general, (t, *cells), changes)
    _, other = jax.jvp(jd.Newton().with_implicit_derivative, (t, *cells), changes)
    np.testing.assert_allclose(one, other, rtol=EXACT, atol=EXACT * float(jnp.abs(other).max()))


@pytest.mark.slow
def test_the_whole_example_has_the_gradient_of_its_height():
    names = block("corotated")
    height, y = names["height"], names["y"]
    rigidity = jnp.where(jnp.asarray(y) < 75, 0.05, 5.0)
    line = jnp.asarray(np.random.default_rng(7).normal(size=len(y))) * rigidity
    slope = jnp.vdot(jax.grad(height)(rigidity), line)

    @jax.jit
    def exact_height(rigidity):  # differences need a state that is exact
        given = names["problem"], names["targets"], rigidity
        tight = jd.QuasiNewton(tolerance=1e-17, max_steps=2000)
        return jnp.mean(jd.deform(*given, local=names["Corotated"](), solver=tight).vertices[:, 1])

    ends = [exact_height(rigidity + s * 1e-3 * line) for s in (1, -1)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-3, rtol=FD)


@pytest.mark.slow
def test_the_law_with_a_volume_has_the_gradient_of_its_deformation(cells):
    """And it is a minimum: Newton's method stays there."""
    names = block("corotated", until="mesh =") | block("volume")
    (code,) = re.findall(r"<!-- law -->\n```python\n(.*?)out = ", PAGE, re.DOTALL)
    exec(compile(code, "law", "exec"), names)
    law, price = names["Volume"](), names["price"]
    found = law.minimize(*cells)
    np.testing.assert_allclose(newton(price, found, *cells), found, atol=1e-9)

    mesh, handles, targets = held_sheet()
    problem = jd.precompute(mesh, handles)
    solver = jd.QuasiNewton(tolerance=1e-15, max_steps=2000)

    def height(log):
        out = jd.deform(problem, targets, jnp.exp(log), local=law, solver=solver)
        return jnp.sum(jnp.sin(out.vertices))

    log = np.random.default_rng(8).normal(size=problem.n_vertices)
    line = np.random.default_rng(9).normal(size=problem.n_vertices)
    slope = jnp.vdot(jax.grad(height)(log), line)
    difference = (height(log + 1e-4 * line) - height(log - 1e-4 * line)) / 2e-4
    np.testing.assert_allclose(slope, difference, rtol=FD)
