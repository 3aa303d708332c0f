"""The factor on the host and the inverse, against SciPy; and that a factor is a value."""

import copy
import gc
import io
import pickle
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg
from factors import DOUBLE, SINGLE, graded, made, solve
from helpers import EXACT

import jaxdeform as jd
from jaxdeform._linalg import cholesky, factor_cache
from jaxdeform._linalg.cholesky import DenseInverse, HostCholesky, dense_inverse, factorise
from jaxdeform._linalg.factor_cache import FactorCache, Matrix, NotPositiveDefinite
from jaxdeform._linalg.host_call import HostFunction
from jaxdeform._mesh.laplacian import normalised_laplacian


def direct(matrix, free, right):
    """Return the solution by SuperLU."""
    out = np.zeros(right.shape)
    inner = matrix[free][:, free].tocsc()
    columns = right[..., free].reshape(-1, free.sum()).T
    out[..., free] = scipy.sparse.linalg.spsolve(inner, columns).T.reshape(*right.shape[:-1], -1)
    return out


@pytest.fixture(params=["FFI", "callback"])
def path(request, monkeypatch):
    """Both ways to the host."""
    if request.param == "callback":
        monkeypatch.setattr(
            cholesky, "_host_solve", HostFunction("", cholesky._solve_on_host, None)
        )
        monkeypatch.setattr(cholesky, "DENSE_BELOW", 0)
        jax.clear_caches()
    yield
    if request.param == "callback":
        jax.clear_caches()


# ---------------------------------------------------------------- the solution


def test_solution_is_the_direct_one(path, right):
    matrix, free = graded()
    for run in (solve, lambda factor, b: factor.solve(b)):
        got = np.asarray(run(made(), jnp.asarray(right)))
        assert np.all(got[..., ~free] == 0.0)
        expected = direct(matrix, free, right)
        np.testing.assert_allclose(got, expected, atol=EXACT * np.abs(expected).max())


def test_dense_inverse_is_the_direct_solution(right):
    matrix, free = graded()
    factor = dense_inverse(matrix, free, DOUBLE)
    got, expected = solve(factor, right), direct(matrix, free, right)
    np.testing.assert_allclose(got, expected, atol=EXACT * np.abs(expected).max())
    assert np.all(np.asarray(factor.inverse)[~free] == 0.0)


@pytest.mark.parametrize("free_from", [0, 1500])
def test_all_free_and_none(free_from, right):
    matrix, free = graded(free_from)
    expected = direct(matrix, free, right) if free.any() else 0 * right
    got = solve(made(free_from), right)
    np.testing.assert_allclose(got, expected, atol=EXACT * max(1.0, np.abs(expected).max()))


def test_no_columns_at_all():
    assert solve(made(), jnp.zeros((0, 3, 1500))).shape == (0, 3, 1500)


def test_vmap_over_right_hand_sides(path, right):
    factor = made()
    expected = solve(factor, right)
    for axis in (0, 1):
        run = jax.jit(jax.vmap(factor.solve, axis, axis))
        np.testing.assert_allclose(run(right), expected, atol=EXACT)
    nested = jax.jit(jax.vmap(jax.vmap(factor.solve)))
    np.testing.assert_allclose(nested(right), expected, atol=EXACT)


def test_vmap_over_matrices(path, right):
    """Also where only one of the two has the axis, and inside another vmap."""
    factors = [made(seed=k) for k in range(2)]
    pair = jax.tree.map(lambda *x: jnp.stack(x), *factors)
    own = jnp.stack([solve(f, b) for f, b in zip(factors, right, strict=True)])
    np.testing.assert_allclose(jax.jit(jax.vmap(HostCholesky.solve))(pair, right), own, atol=EXACT)
    cross = jnp.stack([solve(f, right) for f in factors])
    each = jax.vmap(HostCholesky.solve, (0, None))
    np.testing.assert_allclose(jax.jit(each)(pair, right), cross, atol=EXACT)
    table = jax.vmap(jax.vmap(HostCholesky.solve, (None, 0)), (0, None))
    np.testing.assert_allclose(jax.jit(table)(pair, right), cross, atol=EXACT)
    table = jax.vmap(jax.vmap(HostCholesky.solve, (0, None)), (None, 0), 1)
    np.testing.assert_allclose(jax.jit(table)(pair, right), cross, atol=EXACT)


def test_right_hand_sides_of_a_batch_are_solved_together(monkeypatch, right):
    shapes = []
    solve_columns = cholesky._solve_columns

    def spy(out, matrix, columns):
        shapes.append(columns.shape)
        solve_columns(out, matrix, columns)

    monkeypatch.setattr(cholesky, "_solve_columns", spy)
    jax.vmap(made().solve)(right).block_until_ready()
    assert shapes == [(1500, 6)]


def test_derivatives_are_solutions(path, right):
    factor = made()
    b, y = right
    x, other = solve(factor, b), solve(factor, y)
    pull = jax.jit(lambda b, y: jax.vjp(factor.solve, b)[1](y)[0])(b, y)
    push = jax.jit(lambda b, y: jax.jvp(factor.solve, (b,), (y,))[1])(b, y)
    np.testing.assert_allclose(pull, other, atol=EXACT * np.abs(other).max())
    np.testing.assert_allclose(push, other, atol=EXACT * np.abs(other).max())

    @jax.jit
    @jax.grad
    def slope(b):
        step = jax.checkpoint(lambda x, _: (factor.solve(x), None))
        return jnp.sum(jax.lax.scan(step, b, None, length=2)[0] * y)

    twice = solve(factor, other)
    np.testing.assert_allclose(slope(b), twice, atol=EXACT * np.abs(twice).max())
    del x


def test_single_precision(right):
    low = solve(made(dtype=SINGLE), jnp.asarray(right, jnp.float32))
    high = solve(made(), right)
    assert low.dtype == jnp.float32
    # Condition about 1e4 times the rounding of float32, 6e-8.
    assert np.abs(np.asarray(low) - np.asarray(high)).max() < 1e-3 * np.abs(high).max()


def test_the_matrix_is_exact_without_float64(right):
    """The bilaplacian of this strip is not positive definite in float32."""
    matrix, free = graded()
    normal = sp.csr_matrix(matrix @ matrix)
    with jax.enable_x64(False):
        factor = factorise(normal, free, SINGLE, positions=np.zeros((1500, 3)))
        again = Matrix(*map(np.asarray, jax.tree.leaves(factor)[1:]))
    whole = again.values.reshape(-1).view(np.float64)
    lower = sp.csc_matrix((whole, again.rows, again.starts), shape=normal.shape)
    assert abs(lower - sp.tril(normal)).max() == 0.0


def test_other_handles_have_the_same_shapes():
    shapes = [[x.shape for x in jax.tree.leaves(made(k))] for k in (0, 40, 1000, 1500)]
    assert all(x == shapes[0] for x in shapes)


# ---------------------------------------------------------------- matrices without a factor


def test_an_indefinite_matrix_is_refused_at_once():
    matrix, free = graded()
    with pytest.raises(NotPositiveDefinite, match="not positive definite"):
        factorise(-matrix, free, DOUBLE, positions=np.zeros((1500, 3)))
    with pytest.raises(NotPositiveDefinite):
        dense_inverse(-matrix, free, DOUBLE)


def test_an_indefinite_first_guess_says_so_when_it_is_made(path, right):
    matrix, free = graded()
    factor = factorise(-matrix, free, DOUBLE)
    with pytest.raises(Exception, match=r"not positive definite.*jd\.repair"):
        solve(factor, right).block_until_ready()


def test_rounding_does_not_stop_a_first_guess(right):
    """A singular matrix, seen as slightly indefinite."""
    n = 1500
    path = sp.diags([np.full(n - 1, -1.0), np.full(n, 2.0), np.full(n - 1, -1.0)], [-1, 0, 1])
    path = sp.lil_matrix(path)
    path[0, 0] = path[-1, -1] = 1.0
    singular = sp.csr_matrix(path - 1e-13 * sp.identity(n))
    free = np.ones(n, bool)
    with pytest.raises(NotPositiveDefinite):
        factorise(singular, free, DOUBLE, positions=np.zeros((n, 3)))
    right = right - right.mean(axis=-1, keepdims=True)
    x = np.asarray(solve(factorise(singular, free, DOUBLE), right))
    # What is left is 1e-6 of the diagonal, at most.
    residual = np.abs(x.reshape(-1, n) @ singular - right.reshape(-1, n)).max()
    assert residual < 1e-5 * np.abs(x).max()


@pytest.mark.parametrize("accelerator", [False, True])
def test_a_flat_box_has_a_first_guess(accelerator, monkeypatch):
    """L^T L of a box flattened by 1e-8 is indefinite by rounding."""
    monkeypatch.setattr(cholesky, "has_accelerator", lambda: accelerator)
    bar = jd.shapes.bar()
    mesh = jd.Mesh(bar.vertices * [1.0, 1.0, 1e-8], bar.faces)
    cells = jd.rings(mesh, 1)
    laplacian = normalised_laplacian(cells.edges, cells.weights, cells.n_vertices)
    free = np.arange(mesh.n_vertices) > 20
    factor = factorise(laplacian.T @ laplacian, free, DOUBLE)
    assert isinstance(factor, DenseInverse) == accelerator
    assert np.all(np.isfinite(factor.solve(jnp.ones((3, mesh.n_vertices)))))


# ---------------------------------------------------------------- a value


def in_file(factor):
    """Return what comes back from a file of leaves, read into the factor of other handles."""
    file = io.BytesIO()
    eqx.tree_serialise_leaves(file, factor)
    file.seek(0)
    return eqx.tree_deserialise_leaves(file, made(70, seed=3))


@pytest.mark.parametrize(
    "copied",
    [
        lambda x: pickle.loads(pickle.dumps(x)),
        copy.deepcopy,
        in_file,
        jax.jit(lambda x: x),
        lambda x: jax.tree.map(jnp.copy, x),
    ],
    ids=["pickle", "deepcopy", "file", "jit", "tree"],
)
def test_a_copy_is_as_good(copied, right, monkeypatch):
    expected = np.asarray(solve(made(), right))
    factor = copied(made())
    gc.collect()
    monkeypatch.setattr(cholesky, "factors", FactorCache(1 << 30))  # as in another process
    np.testing.assert_array_equal(solve(factor, right), expected)


def test_functions_outlive_their_factor(right):
    factor = made()
    expected = solve(factor, right)
    run = jax.jit(partial(HostCholesky.solve, factor))
    pull = jax.vjp(factor.solve, jnp.asarray(right))[1]
    run(right)
    del factor
    gc.collect()
    factor_cache.factors.clear()
    np.testing.assert_allclose(run(right), expected, atol=EXACT)
    np.testing.assert_allclose(pull(jnp.asarray(right))[0], expected, atol=EXACT)


def test_another_factor_compiles_nothing(right):
    solve(made(40), right)
    before = solve._cache_size()
    solve(made(80), right)
    solve(made(40, seed=0), right)
    assert solve._cache_size() == before


@pytest.mark.parametrize("name", ["key", "starts", "rows", "values", "free"])
@pytest.mark.parametrize("known", [True, False], ids=["hit", "miss"])
def test_arrays_of_two_factors_never_mix(name, known, right):
    """One array of another factor, or of this one with an entry changed: an error at each solve."""
    one, two = made(), made(41)
    array = np.array(getattr(one, name))
    array.flat[-1] = ~array.flat[-1]
    changed = [array]
    if not np.array_equal(getattr(one, name), getattr(two, name)):
        changed.append(np.array(getattr(two, name)))
    for other in changed:
        mixed = eqx.tree_at(lambda x: getattr(x, name), one, jnp.asarray(other))
        if not known:
            factor_cache.factors.clear()
        for _ in range(2):
            with pytest.raises(Exception, match="do not belong together"):
                solve(mixed, right).block_until_ready()
    np.testing.assert_array_equal(solve(one, right), solve(made(), right))


def test_optimistix_solves_through_a_factor():
    """Its loops begin with zeros in place of the factor's arrays."""
    n = 30
    matrix = scipy.sparse.diags([[-1.0] * (n - 1), [2.5] * n, [-1.0] * (n - 1)], [-1, 0, 1])
    factor = factorise(matrix.tocsr(), np.ones(n, bool), DOUBLE, positions=np.zeros((n, 3)))
    b = jnp.arange(float(n))

    def residual(theta, _):
        return factor.solve(jnp.exp(theta) * b) - factor.solve(2.0 * b)

    peer = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    found = optx.least_squares(residual, peer, jnp.asarray(0.0)).value
    np.testing.assert_allclose(found, np.log(2.0), rtol=1e-8)
