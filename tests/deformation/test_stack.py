"""Stacks of problems under vmap: each mesh as if it were alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NO_SADDLES

import jaxdeform as jd
from jaxdeform._linalg import factor_cache


def sheet(rows: int, columns: int, height: float) -> jd.Mesh:
    x, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    vertices = np.stack([x, y, height * np.sin(x + 0.7 * y)], axis=-1).reshape(-1, 3)
    i = (x * columns + y)[:-1, :-1].ravel()
    faces = [[i, i + columns, i + 1], [i + 1, i + columns, i + columns + 1]]
    return jd.Mesh(vertices, np.concatenate([np.stack(f, axis=1) for f in faces]))


MESHES = [sheet(5, 6, 0.2), sheet(6, 6, 0.3), sheet(8, 7, 0.4)]
MOVE = np.array([[0.0, 0.0, 0.0]] * 4 + [[0.3, -0.2, 1.5]] * 4)


@pytest.fixture(scope="module")
def problems() -> list[jd.Problem]:
    return [
        jd.precompute(mesh, [0, 1, 2, 3, *range(mesh.n_vertices - 4, mesh.n_vertices)])
        for mesh in MESHES
    ]


@pytest.fixture(scope="module")
def targets(problems) -> np.ndarray:
    return np.stack([problem.vertices[problem.handles] + MOVE for problem in problems])


@pytest.mark.slow
@pytest.mark.parametrize("lam", [0.02, 5.0])
def test_each_mesh_is_as_if_alone(problems, targets, lam):
    """Also where the metric knows the rigidity (0.02), of which each mesh has a factor."""
    stack = jd.stack_problems(problems)
    out = jax.vmap(lambda problem, targets: jd.deform(problem, targets, lam))(stack, targets)
    assert out.ok.all()
    for k, (problem, goal) in enumerate(zip(problems, targets, strict=True)):
        alone = jd.deform(problem, goal, lam)
        count = problem.n_vertices
        np.testing.assert_allclose(out.vertices[k, :count], alone.vertices, atol=1e-8)
        np.testing.assert_allclose(out.transforms[k, :count], alone.transforms, atol=1e-8)
        rest = np.broadcast_to(problem.mesh.center, out.vertices[k, count:].shape)
        np.testing.assert_allclose(out.vertices[k, count:], rest, atol=1e-12)
        assert out.steps[k] == alone.steps


@pytest.mark.slow
def test_gradients_are_those_of_each_mesh(problems, targets):
    def height(problem, targets, lam):
        out = jd.deform(problem, targets, lam, solver=NO_SADDLES)
        return jnp.sum(out.vertices[:, 2] ** 2)

    stack, lam = jd.stack_problems(problems), jnp.asarray([0.1, 1.0, 10.0])
    found = jax.vmap(jax.grad(height, argnums=(1, 2)))(stack, jnp.asarray(targets), lam)
    for k, problem in enumerate(problems):
        own = jax.grad(height, argnums=(1, 2))(problem, jnp.asarray(targets[k]), lam[k])
        for one, other in zip(found, own, strict=True):
            # What fills up is at the centre, and adds its constant height.
            np.testing.assert_allclose(one[k], other, rtol=1e-6, atol=1e-8)


def test_fields_of_rigidity_are_as_long_as_the_arrays(problems, targets):
    stack = jd.stack_problems(problems)
    fields = [0.1 + problem.vertices[:, 0] for problem in problems]
    full = [np.pad(field, (0, stack.n_vertices - len(field))) for field in fields]
    solver = jd.Alternating(5)
    out = jax.vmap(lambda *x: jd.deform(*x, solver=solver).vertices)(stack, targets, np.stack(full))
    for k, problem in enumerate(problems):
        alone = jd.deform(problem, targets[k], fields[k], solver=solver).vertices
        np.testing.assert_allclose(out[k, : problem.n_vertices], alone, atol=1e-10)


def test_a_stack_tells_what_it_is_for(problems, targets):
    stack = jd.stack_problems(problems)
    assert repr(stack) == f"Problem(3 stacked, {stack.n_vertices} vertices, float64)"
    with pytest.raises(jd.InputError, match=r"jax\.vmap"):
        jd.deform(stack, targets, 1.0)
    with pytest.raises(jd.InputError, match="ask the problems in it"):
        _ = stack.mesh


def test_what_cannot_be_stacked_is_named(problems):
    mesh = MESHES[0]
    bad = {
        "give a list of problems": problems[0],
        "give at least one": [],
        "problem must be|problem is": [problems[0], mesh],
        "problem 1 has 1 handles, but the first has 8": [problems[0], jd.precompute(mesh, [0])],
        "arrays of other sizes": [problems[0], jd.precompute(sheet(12, 12, 0.1), range(8))],
        "numbers of one type": [problems[0], jd.precompute(mesh, range(8), dtype=np.float32)],
    }
    for text, given in bad.items():
        with pytest.raises(jd.InputError, match=text):
            jd.stack_problems(given)
    with pytest.raises(jd.InputError, match="traced"):
        jax.jit(lambda problem: jd.stack_problems([problem]).system.rest)(problems[0])


def test_a_stack_keeps_its_factors(problems):
    """Also when the problems that it was made of are gone."""
    stack = jd.stack_problems(problems)
    keys = np.concatenate([stack.system.factor.key, stack.system.initial_guess.factor.key])
    owners = factor_cache.factors._owners
    counts = [owners[key.tobytes()] for key in keys]
    again = jd.stack_problems(problems)
    assert [owners[key.tobytes()] for key in keys] == [count + 1 for count in counts]
    assert again.system.factor.key.shape == (3, 4)
