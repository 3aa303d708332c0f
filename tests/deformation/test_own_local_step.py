"""A user's own local step: it works in deform, and what is none is refused at once."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FD, ends, held_sheet

import jaxdeform as jd


@dataclass(frozen=True)
class Corotated:
    """lambda |T - R|^2, R the rotation closest to T; docs/derivatives.md has the closed form."""

    factor: float = 1.0

    def solve(self, c, b, rigidity, rotate):
        pull = b + self.factor * rigidity[None]
        rotation = rotate(c / pull[:, None])
        return (jnp.swapaxes(c, 0, 1) + self.factor * rigidity[None, None] * rotation) / pull[None]

    def minimize(self, c, b, rigidity):
        return self.solve(c, b, rigidity, lambda d: jd.RotationFit().minimize(d, b, rigidity))

    def with_implicit_derivative(self, t, c, b, rigidity):
        def rotate(d):
            r = jd.RotationFit().minimize(jax.lax.stop_gradient(d), b, rigidity)
            return jd.RotationFit().with_implicit_derivative(r, d, b, rigidity)

        again = self.solve(c, b, rigidity, rotate)
        return t + again - jax.lax.stop_gradient(again)

    def energy(self, t, c, b, rigidity):
        turned = jnp.swapaxes(t, 0, 1)
        r = jd.RotationFit().minimize(jax.lax.stop_gradient(turned), b, rigidity)
        r = jd.RotationFit().with_implicit_derivative(r, turned, b, rigidity)
        strain = self.factor * rigidity * jnp.sum((t - r) ** 2, axis=(0, 1))
        return strain + jnp.sum(t**2 * b[None] - 2 * t * jnp.swapaxes(c, 0, 1), axis=(0, 1))


@pytest.fixture(scope="module")
def sheet():
    mesh, handles, targets = held_sheet()
    return jd.precompute(mesh, handles), targets


@pytest.mark.slow
def test_another_material_reaches_its_own_equilibrium(sheet):
    """At the end A p' = K^T T: a further step moves nothing; another material ends elsewhere."""
    problem, targets = sheet
    ends = {
        local: jd.deform(problem, targets, 0.3, local=local, solver=jd.Alternating(1000)).vertices
        for local in (Corotated(), Corotated(2.0), jd.Newton())
    }
    again = jd.deform(
        problem, targets, 0.3, local=Corotated(), solver=jd.Alternating(1), start=ends[Corotated()]
    )
    np.testing.assert_allclose(again.vertices, ends[Corotated()], atol=1e-8)
    doubled = jd.deform(problem, targets, 0.6, local=Corotated(), solver=jd.Alternating(1000))
    np.testing.assert_allclose(doubled.vertices, ends[Corotated(2.0)], atol=1e-8)
    assert np.abs(ends[jd.Newton()] - ends[Corotated()]).max() > 1e-3


@pytest.mark.slow
def test_both_solvers_reach_the_minimum_of_another_energy(sheet):
    """QuasiNewton accepts steps by the energy of the law, not by that of Eq. 4.4."""
    (problem, targets), local = sheet, Corotated()
    slow = jd.deform(problem, targets, 0.3, local=local, solver=jd.Alternating(1000))
    fast = jd.deform(problem, targets, 0.3, local=local, solver=jd.QuasiNewton(tolerance=1e-14))
    assert fast.result == jd.Result.converged
    np.testing.assert_allclose(fast.energy[-1], slow.energy[-1], rtol=1e-12)
    np.testing.assert_allclose(fast.vertices, slow.vertices, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "adjoint"), [(5, jd.Unrolled()), (1000, jd.Implicit())], ids=["unrolled", "implicit"]
)
def test_gradients_through_another_material(sheet, steps, adjoint):
    problem, targets = sheet
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(problem.n_vertices, 3)))
    settings = {"local": Corotated(), "solver": jd.Alternating(steps), "adjoint": adjoint}

    @jax.jit
    def loss(log_rigidity, targets):
        out = jd.deform(problem, targets, jnp.exp(log_rigidity), **settings)
        return jnp.sum(weight * out.vertices)

    at = jnp.asarray(rng.normal(size=problem.n_vertices)), jnp.asarray(targets)
    slopes = jax.grad(loss, argnums=(0, 1))(*at)
    for k, slope in enumerate(slopes):
        direction, h = jnp.asarray(rng.normal(size=slope.shape)), 1e-4
        ends = [
            loss(*(x + s * h * direction if i == k else x for i, x in enumerate(at)))
            for s in (1, -1)
        ]
        np.testing.assert_allclose(
            jnp.sum(slope * direction), (ends[0] - ends[1]) / (2 * h), rtol=FD
        )


# ---------------------------------------------------------------- what is no local step


class NoDerivative:
    def minimize(self, c, b, rigidity): ...


class OldProtocol(Corotated):
    def minimize(self, c, b): ...


class Unhashable(Corotated):
    __hash__ = None


class CellsFirst(Corotated):
    def minimize(self, c, b, rigidity):
        return jnp.moveaxis(super().minimize(c, b, rigidity), -1, 0)


class Single(Corotated):
    def minimize(self, c, b, rigidity):
        return super().minimize(c, b, rigidity).astype(jnp.float32)


class Forgetful(Corotated):
    def with_implicit_derivative(self, t, c, b, rigidity):
        return None


class SumOfEnergies(jd.Newton):
    def energy(self, t, c, b, rigidity):
        return jnp.sum(super().energy(t, c, b, rigidity))


class Wordy(Corotated):
    def energy(self, t, c, b, rigidity):
        return "much"


class StrainOfAxes(Corotated):
    def strain_rigidity(self, rigidity):
        return jnp.stack([rigidity] * 3)


class StrainOfNothing(Corotated):
    def strain_rigidity(self):
        return 1.0


WRONG = {
    r"SumOfEnergies.energy returned float64\[\] for 5 cells": SumOfEnergies(),
    "Wordy.energy returned a str for 5 cells": Wordy(),
    r"StrainOfAxes.strain_rigidity returned float64\[3, 5\]": StrainOfAxes(),
    r"StrainOfNothing.strain_rigidity cannot be called with \(rigidity\)": StrainOfNothing(),
    "text 'arap': give a local step, such as .*RotationFit": "arap",
    r"class RotationFit: give RotationFit\(\) instead": jd.RotationFit,
    "local is None, without minimize: give a local step": None,
    "local is a NoDerivative, without with_implicit_derivative": NoDerivative(),
    r"OldProtocol.minimize cannot be called with \(c, b, rigidity\)": OldProtocol(),
    "Unhashable is not hashable.*frozen": Unhashable(),
    r"CellsFirst.minimize returned .*\(3, 3, 5\)": CellsFirst(),
    "Single.minimize returned .*float32": Single(),
    "Forgetful.with_implicit_derivative returned None": Forgetful(),
}


class Double(Corotated):
    def energy(self, t, c, b, rigidity):
        return super().energy(t, c, b, rigidity).astype(jnp.float64)


def test_a_law_is_asked_for_the_type_of_the_problem(bar):
    """Which may be float32 where JAX computes in float64."""
    problem = jd.precompute(bar, ends(bar), dtype=np.float32)
    targets = jd.bend(bar.vertices[ends(bar)], 20.0)
    assert bool(jd.deform(problem, targets, 1.0, local=Corotated()).ok)
    with pytest.raises(jd.InputError, match=r"Double.energy returned float64\[5\]"):
        jd.deform(problem, targets, 1.0, local=Double())


@pytest.mark.parametrize("message", WRONG)
def test_what_is_no_local_step_is_refused(sheet, message):
    problem, targets = sheet
    with pytest.raises(jd.InputError, match=message):
        jd.deform(problem, targets, 0.3, local=WRONG[message])


def test_the_protocol_is_public():
    assert isinstance(Corotated(), jd.LocalStep)
    assert not isinstance(NoDerivative(), jd.LocalStep)


# ---------------------------------------------------------------- cells without a solution


@dataclass(frozen=True)
class Failing(jd.Newton):
    """NaN in cells 3 and 7 once ``sign |T|^2`` of cell 3 is above a limit."""

    limit: float = -np.inf
    sign: float = 1.0

    def minimize(self, c, b, rigidity):
        t = super().minimize(c, b, rigidity)
        fails = self.sign * jnp.sum(t[..., 3] ** 2) > self.limit
        return t.at[..., jnp.asarray([3, 7])].set(jnp.where(fails, jnp.nan, t[..., [3, 7]]))


@pytest.mark.parametrize("when", ["at the start", "on the way"])
@pytest.mark.parametrize(
    "solver",
    [jd.Alternating(20), jd.Alternating(20, tolerance=1e-12), jd.QuasiNewton()],
    ids=["alternating", "to a tolerance", "quasi-newton"],
)
def test_the_cells_that_failed_are_named(sheet, solver, when):
    """The failure stays in its cells, and all positions stay finite."""
    problem, targets = sheet
    fine = jd.deform(problem, targets, 0.3, solver=solver)
    assert "Cells at fault" not in fine.explain()
    local = Failing()
    if when == "on the way":
        early = jd.deform(problem, targets, 0.3, solver=jd.Alternating(1))
        first, last = (float(np.sum(np.square(x.transforms[3]))) for x in (early, fine))
        sign = float(np.sign(last - first))
        local = Failing(limit=sign * (first + last) / 2, sign=sign)
    out = jd.deform(problem, targets, 0.3, solver=solver, local=local)
    assert (int(out.steps) > 0) == (when == "on the way")
    assert bool(out.result == jd.Result.not_finite)
    assert not bool(out.ok)
    assert np.isfinite(out.vertices).all()
    bad = np.flatnonzero(np.isnan(out.transforms).any(axis=(1, 2)))
    assert bad.tolist() == [3, 7]
    assert f"Cells at fault: 3, 7 (2 of {problem.n_vertices})." in out.explain()
