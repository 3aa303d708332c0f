"""Laplacian editing and RC-ARAP against the same sums written as loops and dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FD, bumpy_sheet, ends
from scipy.spatial.transform import Rotation

import jaxdeform as jd


@pytest.fixture(scope="module")
def sheet() -> jd.Mesh:
    return bumpy_sheet()


HANDLES = np.array([0, 7, 27, 48, 55])


def moved(points):
    return np.asarray(points) + np.random.default_rng(0).normal(size=(len(points), 3))


def weight_matrix(mesh, kind):
    """w_ij by angles: (cot a + cot b) / 2, or 1."""
    w = np.zeros((mesh.n_vertices,) * 2)
    for face in mesh.faces:
        for a, b, c in (face, np.roll(face, 1), np.roll(face, 2)):
            u, v = mesh.vertices[a] - mesh.vertices[c], mesh.vertices[b] - mesh.vertices[c]
            angle = np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v))
            w[a, b] = w[b, a] = w[a, b] + 0.5 / np.tan(angle) if kind == "cotangent" else 1.0
    return w


def laplacian_matrix(w):
    """L of the thesis, row by row."""
    out = np.eye(len(w))
    for i, row in enumerate(w):
        for j in np.flatnonzero(row):
            out[i, j] = -row[j] / row.sum()
    return out


def solved(operator, right, handles, targets, weight):
    """Least squares with hard handles (columns moved over) or soft ones (rows added)."""
    n = operator.shape[1]
    if np.isinf(weight):
        free = np.setdiff1d(np.arange(n), handles)
        out = np.empty((n, *np.shape(targets)[1:]))
        out[handles] = targets
        rest = right - operator[:, handles] @ targets
        out[free] = np.linalg.lstsq(operator[:, free], rest, rcond=None)[0]
        return out
    root = np.sqrt(weight)
    rows = np.concatenate([operator, root * np.eye(n)[handles]])
    return np.linalg.lstsq(rows, np.concatenate([right, root * targets]), rcond=None)[0]


def settings(mesh, kind, weight):
    return {
        "weights": None if kind == "cotangent" else np.ones(len(mesh.edges)),
        "handle_weights": weight,
    }


@pytest.mark.parametrize("weight", [np.inf, 0.7])
@pytest.mark.parametrize("kind", ["uniform", "cotangent"])
def test_plain_editing_is_eq_3_2(sheet, kind, weight):
    targets = moved(sheet.vertices[HANDLES])
    operator = laplacian_matrix(weight_matrix(sheet, kind))
    want = solved(operator, operator @ sheet.vertices, HANDLES, targets, weight)
    got = jd.laplacian_editing(sheet, HANDLES, targets, **settings(sheet, kind, weight))
    np.testing.assert_allclose(got, want, atol=1e-8)  # lstsq solves the squared condition number


def similarity_matrix(mesh, operator):
    """(3n, 3n): p' to T_i(p') delta_i, T_i = s I + h x fitted to the neighbourhood with a shift."""
    n = mesh.n_vertices
    delta = operator @ mesh.vertices
    out = np.zeros((n, 3, n, 3))

    def cross(q):
        return np.array([[0, q[2], -q[1]], [-q[2], 0, q[0]], [q[1], -q[0], 0]])  # h -> h x q

    for i in range(n):
        around = np.flatnonzero(operator[i])  # i and its neighbours
        basis = np.concatenate(
            [np.hstack([q[:, None], cross(q), np.eye(3)]) for q in mesh.vertices[around]]
        )
        fit = np.linalg.pinv(basis)  # (7, 3 neighbours) -> s, h, shift
        turned = np.hstack([delta[i][:, None], cross(delta[i])]) @ fit[:4]
        out[i, :, around] = turned.reshape(3, -1, 3).swapaxes(0, 1)
    return out.reshape(3 * n, 3 * n)


@pytest.mark.parametrize("weight", [np.inf, 0.7])
@pytest.mark.parametrize("kind", ["uniform", "cotangent"])
def test_similarity_editing_is_sorkine_2004(sheet, kind, weight):
    targets = moved(sheet.vertices[HANDLES])
    plain = laplacian_matrix(weight_matrix(sheet, kind))
    operator = np.kron(plain, np.eye(3)) - similarity_matrix(sheet, plain)
    handles = (3 * HANDLES[:, None] + np.arange(3)).ravel()
    want = solved(operator, np.zeros(len(operator)), handles, targets.ravel(), weight)
    got = jd.laplacian_editing(
        sheet, HANDLES, targets, similarity=True, **settings(sheet, kind, weight)
    )
    np.testing.assert_allclose(got, want.reshape(-1, 3), atol=1e-7)  # as above


# ---------------------------------------------------------------- invariants


@pytest.mark.parametrize("similarity", [False, True])
def test_translations_are_reproduced(bar, similarity):
    handles = ends(bar)
    editor = jd.laplacian_editor(bar, handles, similarity=similarity)
    for shift in ([0.0, 0, 0], [5.0, -20.0, 300.0]):
        out = editor(bar.vertices[handles] + shift)
        np.testing.assert_allclose(out, bar.vertices + shift, atol=1e-7)


def test_only_the_similarity_grows_and_turns_with_its_handles(bar):
    """Scale is exact, a rotation to first order; plain details keep their size and direction."""
    handles = ends(bar)
    plain = jd.laplacian_editor(bar, handles)
    similar = jd.laplacian_editor(bar, handles, similarity=True)
    out = similar(1.7 * bar.vertices[handles])
    np.testing.assert_allclose(out, 1.7 * bar.vertices, atol=1e-6)
    assert np.abs(plain(1.7 * bar.vertices[handles]) - 1.7 * bar.vertices).max() > 1.0

    def error(editor, angle):
        turned = bar.vertices @ Rotation.from_rotvec([0.6 * angle, 0, 0.8 * angle]).as_matrix().T
        return np.abs(editor(turned[handles]) - turned).max()

    assert 1.9 < error(plain, 0.02) / error(plain, 0.01) < 2.1
    assert 3.8 < error(similar, 0.02) / error(similar, 0.01) < 4.2


def test_unreferenced_vertices_stay(sheet):
    mesh = jd.Mesh(np.concatenate([sheet.vertices, [[9.0, 9.0, 9.0]]]), sheet.faces)
    targets = moved(sheet.vertices[HANDLES])
    for similarity in (False, True):
        out = np.asarray(jd.laplacian_editing(mesh, HANDLES, targets, similarity=similarity))
        want = jd.laplacian_editing(sheet, HANDLES, targets, similarity=similarity)
        np.testing.assert_array_equal(out[-1], [9, 9, 9])
        np.testing.assert_allclose(out[:-1], want, atol=1e-8)


# ---------------------------------------------------------------- transformations of JAX


@pytest.mark.parametrize("similarity", [False, True])
@pytest.mark.parametrize("name", ["sheet", "cylinder"])
def test_derivatives_to_the_targets(sheet, name, similarity):
    """The map is affine, so a difference is exact; both kinds of factor; jit and vmap."""
    mesh = sheet if name == "sheet" else jd.shapes.cylinder()
    handles = HANDLES if name == "sheet" else ends(mesh)
    editor = jd.laplacian_editor(mesh, handles, similarity=similarity)
    rng = np.random.default_rng(1)
    targets, move = rng.normal(size=(2, len(handles), 3))
    goal = rng.normal(size=(mesh.n_vertices, 3))
    loss = jax.jit(lambda t: jnp.sum(goal * editor(t)))
    want = (loss(targets + move) - loss(targets - move)) / 2
    np.testing.assert_allclose(jnp.sum(jax.grad(loss)(targets) * move), want, rtol=FD)
    np.testing.assert_allclose(jax.jvp(loss, (targets,), (move,))[1], want, rtol=FD)
    both = jax.vmap(editor)(jnp.stack([targets, move]))
    np.testing.assert_allclose(both[1], editor(move), atol=1e-7)


# ---------------------------------------------------------------- bad input


def bad_calls(mesh):
    targets = mesh.vertices[HANDLES]
    nan = targets.copy()
    nan[2] = np.nan
    edit = jd.laplacian_editing
    return {
        "handle 56 .*out of range": lambda: edit(mesh, [0, 56], targets[:2]),
        "vertex 3 is a handle 2 times": lambda: edit(mesh, [3, 3], targets[:2]),
        "targets have shape": lambda: edit(mesh, HANDLES, targets[:-1]),
        "targets of handle 2 are not finite": lambda: edit(mesh, HANDLES, nan),
        "the weight of handle 7 is -1": lambda: edit(
            mesh, HANDLES, targets, handle_weights=[1, -1, 1, 1, 1]
        ),
        "handle_weights have shape": lambda: edit(mesh, HANDLES, targets, handle_weights=[1.0]),
        "weights have shape": lambda: edit(mesh, HANDLES, targets, weights=np.ones(3)),
        "no handle": lambda: edit(mesh, HANDLES, targets, handle_weights=0.0),
        "at least three vertices": lambda: edit(mesh, [4], targets[:1], similarity=True),
    }


@pytest.mark.parametrize("message", bad_calls(jd.shapes.bar()))
def test_bad_input_gets_a_clear_error(sheet, message):
    with pytest.raises(jd.InputError, match=message) as caught:
        bad_calls(sheet)[message]()
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- RC-ARAP


def reached(mesh, k, r):
    """Vertices within r rings of k."""
    inside = {k}
    for _ in range(r):
        inside |= {int(v) for face in mesh.faces if inside & set(face.tolist()) for v in face}
    return inside


def test_rotation_fit_on_rings_is_rc_arap(sheet):
    """Eq. 3.4 with r from 1 to 3: loops over cells and edges, LAPACK's SVD, a dense solve."""
    n, rest = sheet.n_vertices, sheet.vertices
    r = np.random.default_rng(2).integers(1, 4, n)
    w = weight_matrix(sheet, "cotangent")
    members = [
        [(i, j) for i, j in sheet.edges.tolist() if i in inside and j in inside]
        for inside in (reached(sheet, k, r[k]) for k in range(n))
    ]
    system = np.zeros((n, n))
    for edges in members:
        for i, j in edges:
            system[[i, j], [i, j]] += w[i, j]
            system[[i, j], [j, i]] -= w[i, j]
    free = np.setdiff1d(np.arange(n), HANDLES)
    targets = moved(rest[HANDLES])
    start = np.array(jd.laplacian_editing(sheet, HANDLES, targets))
    p = start.copy()
    for _ in range(10):
        right = np.zeros((n, 3))
        for edges in members:
            c = sum(w[i, j] * np.outer(rest[i] - rest[j], p[i] - p[j]) for i, j in edges)
            u, _, vt = np.linalg.svd(c)
            flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
            turn = vt.T @ flip @ u.T
            for i, j in edges:
                side = w[i, j] * turn @ (rest[i] - rest[j])
                right[i] += side
                right[j] -= side
        p[HANDLES] = targets
        fixed = system[np.ix_(free, HANDLES)] @ targets
        p[free] = np.linalg.solve(system[np.ix_(free, free)], right[free] - fixed)
    problem = jd.precompute(sheet, HANDLES, cells=jd.rings(sheet, r))
    out = jd.deform(
        problem, targets, 0.0, local=jd.RotationFit(), solver=jd.Alternating(10), start=start
    )
    np.testing.assert_allclose(out.vertices, p, atol=1e-9)


@pytest.mark.parametrize("similarity", [False, True])
def test_far_from_the_origin_is_as_near(sheet, similarity):
    """A million diagonals away, where a coordinate has ten digits left."""
    shift = 1e6 * sheet.diagonal * np.array([1.0, -2.0, 0.5])
    far = jd.Mesh(sheet.vertices + shift, sheet.faces)
    targets = moved(sheet.vertices[HANDLES])
    near = jd.laplacian_editing(sheet, HANDLES, targets, similarity=similarity)
    out = jd.laplacian_editing(far, HANDLES, targets + shift, similarity=similarity)
    np.testing.assert_allclose(np.asarray(out) - shift, near, atol=1e-8 * sheet.diagonal)
