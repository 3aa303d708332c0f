"""Derivatives to the rest shape and the edge weights, by differences of precompute and deform."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FD, held_sheet, replaced

import jaxdeform as jd

# Differences of 1e-5 need 1e-10. (The look for saddles takes half the time of compilation.)
TIGHT = jd.QuasiNewton(tolerance=1e-21, max_steps=2000, leave_saddles=False)


@pytest.fixture(scope="module")
def case():
    mesh, handles, targets = held_sheet()
    rng = np.random.default_rng(2)
    weight = jnp.asarray(rng.normal(size=mesh.vertices.shape))
    direction = 0.1 * rng.normal(size=mesh.vertices.shape)
    rigidity = rng.uniform(0.2, 2.0, mesh.n_vertices)
    return mesh, handles, targets, rigidity, weight, direction


def value(out, weight, of_transforms=1.0):
    shape = jnp.sum(weight * out.vertices) + 3.0 * out.energy[-1]
    t = jnp.einsum("ki,kij->", weight, out.transforms)
    return shape + of_transforms * t


LAWS = [jd.Newton(), jd.RotationFit(), jd.AffineFit()]
CASES = [(local, np.inf) for local in LAWS] + [(jd.Newton(), 2.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("local", "soft"), CASES)
def test_derivatives_to_the_rest_shape(case, local, soft):
    mesh, handles, targets, rigidity, weight, direction = case
    # The affine fit of a flat cell (a corner with one face) jumps along the normal with the shape.
    part = 0.0 if local == jd.AffineFit() else 1.0

    def whole(s):
        moved = jd.Mesh(mesh.vertices + s * direction, mesh.faces)
        problem = jd.precompute(moved, handles, handle_weights=soft)
        out = jd.deform(problem, targets, rigidity, local=local, solver=TIGHT)
        return value(out, weight, part)

    problem = jd.precompute(mesh, handles, handle_weights=soft)
    h = 1e-5
    want = float(whole(h) - whole(-h)) / (2 * h)

    @jax.jit
    def loss(rest):
        out = jd.deform(problem, targets, rigidity, local=local, rest=rest)
        return value(out, weight, part)

    rest = jnp.asarray(mesh.vertices)
    _, forward = jax.jvp(loss, (rest,), (jnp.asarray(direction),))
    np.testing.assert_allclose(forward, want, rtol=FD)
    np.testing.assert_allclose(jnp.sum(jax.grad(loss)(rest) * direction), want, rtol=FD)


@pytest.mark.slow
def test_derivatives_to_the_edge_weights(case):
    mesh, handles, targets, rigidity, weight, _ = case
    w = jd.cotangent_weights(mesh) + 0.3
    direction = np.random.default_rng(3).normal(size=w.shape)

    def whole(s):
        cells = jd.rings(mesh, weights=w + s * direction)
        problem = jd.precompute(mesh, handles, cells=cells)
        return value(jd.deform(problem, targets, rigidity, solver=TIGHT), weight)

    problem = jd.precompute(mesh, handles, cells=jd.rings(mesh, weights=w))
    want = float(whole(1e-5) - whole(-1e-5)) / 2e-5

    @jax.jit
    def loss(weights):
        return value(jd.deform(problem, targets, rigidity, edge_weights=weights), weight)

    _, forward = jax.jvp(loss, (jnp.asarray(w),), (jnp.asarray(direction),))
    np.testing.assert_allclose(forward, want, rtol=FD)
    np.testing.assert_allclose(jnp.sum(jax.grad(loss)(jnp.asarray(w)) * direction), want, rtol=FD)


def forward(function):
    """Return the derivative along the first unknown, in forward mode."""
    return lambda x: jax.jvp(function, (x,), (jnp.array([1.0, 0.0]),))[1]


def reverse(function):
    """Return the derivative along the first unknown, in reverse mode."""
    return lambda x: jax.grad(function)(x)[0]


@pytest.fixture(scope="module")
def second_derivatives(case):
    """Twice along a direction, and along it and to the rigidity, by differences of the whole."""
    mesh, handles, targets, _, weight, direction = case
    settings = {"solver": replace(TIGHT, tolerance=1e-16)}
    near = jd.deform(jd.precompute(mesh, handles), targets, 0.7, **settings).vertices

    def whole(s, u):
        moved = jd.precompute(jd.Mesh(mesh.vertices + s * direction, mesh.faces), handles)
        return value(jd.deform(moved, targets, 0.7 * np.exp(u), start=near, **settings), weight)

    h = 1e-2
    f = {k: float(whole(k * h, 0.0)) for k in range(-2, 3)}
    twice = (16 * (f[1] + f[-1]) - f[2] - f[-2] - 30 * f[0]) / (12 * h**2)
    corners = [i * j * whole(i * h, j * h) for i in (-1, 1) for j in (-1, 1)]
    mixed = float(sum(corners)) / (4 * h**2)

    return near, twice, mixed


@pytest.mark.slow
@pytest.mark.parametrize("inner", [forward, reverse])
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_to_the_rest_shape(case, second_derivatives, inner, outer):
    mesh, handles, targets, _, weight, direction = case
    near, twice, mixed = second_derivatives
    problem = jd.precompute(mesh, handles)

    def loss(x):
        rest = jnp.asarray(mesh.vertices) + x[0] * direction
        return value(
            jd.deform(problem, targets, 0.7 * jnp.exp(x[1]), rest=rest, start=near), weight
        )

    got = jax.jit(outer(inner(loss)))(jnp.zeros(2))
    np.testing.assert_allclose(got[0], twice, rtol=2e-3)
    np.testing.assert_allclose(got[1], mixed, rtol=1e-2)  # the difference is of second order


def test_another_rest_shape_is_refused_and_said_inside_jit(case):
    mesh, handles, targets, *_ = case
    problem = jd.precompute(mesh, handles)
    other = replaced(mesh.vertices, (5, 2), 9.0)
    with pytest.raises(jd.InputError, match="rest of vertex 5 are not the problem's own"):
        jd.deform(problem, targets, 1.0, rest=other)
    with pytest.raises(jd.InputError, match="edge_weights of edge 0 are not the problem's own"):
        jd.deform(problem, targets, 1.0, edge_weights=problem.cells.weights + 1.0)
    run = jax.jit(lambda rest: jd.deform(problem, targets, 1.0, rest=rest).result)
    assert run(jnp.asarray(other)) == jd.Result.bad_input
    assert run(jnp.asarray(mesh.vertices)) == jd.Result.converged
    run = jax.jit(lambda weights: jd.deform(problem, targets, 1.0, edge_weights=weights).result)
    assert run(jnp.asarray(problem.cells.weights + 1.0)) == jd.Result.bad_input
    assert run(jnp.asarray(problem.cells.weights)) == jd.Result.converged


def test_what_is_taken_for_the_problems_own_converges(case):
    """Inside jit and outside alike, also in float32, where more is rounding."""
    mesh, handles, targets, *_ = case
    for dtype, near in ((np.float64, 1e-14), (np.float32, 5e-6)):
        problem = jd.precompute(mesh, handles, dtype=dtype)
        weights = np.asarray(problem.cells.weights, dtype)
        weights = weights + near * weights.max()
        out = jd.deform(problem, targets, 1.0, edge_weights=weights)
        assert bool(out.result == jd.Result.converged), dtype


def test_the_problems_own_are_known_far_from_the_origin_too(case):
    """In float32, where a position is rounded to 1e-4 of the mesh."""
    mesh, handles, targets, *_ = case
    move = 900.0 * mesh.diagonal
    problem = jd.precompute(jd.Mesh(mesh.vertices + move, mesh.faces), handles, dtype=np.float32)
    weights = problem.cells.weights
    out = jd.deform(problem, targets + move, 1.0, edge_weights=weights)
    assert out.result == jd.Result.converged
    rest = jnp.asarray(problem.vertices, np.float32)
    run = jax.jit(lambda rest: jd.deform(problem, targets + move, 1.0, rest=rest).result)
    assert run(rest) == jd.Result.converged


@pytest.mark.slow
@pytest.mark.parametrize("first", [jax.jacfwd, jax.grad])
def test_third_derivatives_to_the_rest_shape_raise(case, first):
    mesh, handles, targets, _, weight, direction = case
    problem = jd.precompute(mesh, handles)

    def loss(x):
        rest = jnp.asarray(mesh.vertices) + x * direction
        return value(jd.deform(problem, targets, 0.7, rest=rest), weight)

    with pytest.raises(jd.InputError, match="first and second derivatives only"):
        jax.make_jaxpr(jax.jacfwd(jax.jacfwd(first(loss))))(0.0)


def test_what_has_no_derivative_raises(case):
    mesh, handles, targets, *_ = case
    problem = jd.precompute(mesh, handles)

    def loss(system):
        moved = jd.Problem(system, problem.handles, problem.cells)
        return jnp.sum(jd.deform(moved, targets, 1.0).vertices ** 2)

    with pytest.raises(jd.InputError, match="arrays of a Problem have no derivative"):
        jax.grad(loss, allow_int=True)(problem.system)
    for solver in (jd.Alternating(5),):
        with pytest.raises(jd.InputError, match="differentiated by Implicit"):
            jd.deform(problem, targets, 1.0, rest=mesh.vertices, solver=solver)
