"""Meshes of one bucket share the compiled code, and what fills them up changes nothing."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NO_SADDLES, without_buckets

import jaxdeform as jd
from benchmarks.harness import compilations
from jaxdeform._linalg.buckets import bucket

AROUND = 8


def tube(rows: int) -> jd.Mesh:
    """Return an open tube of some rows of vertices, closed by no pole, bulging in the middle."""
    turn = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    height = np.linspace(0.0, 10.0, rows)
    radius = np.repeat(1.0 + 0.2 * np.sin(height), AROUND)
    turn, height = np.tile(turn, rows), np.repeat(height, AROUND)
    vertices = np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1)
    i = AROUND * np.arange(rows - 1)[:, None] + np.arange(AROUND)
    j = AROUND * np.arange(rows - 1)[:, None] + (np.arange(AROUND) + 1) % AROUND
    faces = [(i, i + AROUND, j), (j, i + AROUND, j + AROUND)]
    return jd.Mesh(vertices, np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in faces]))


def handles_of(mesh: jd.Mesh) -> np.ndarray:
    y = mesh.vertices[:, 1]
    return np.flatnonzero((y < 0.7) | (y > 9.3))


def setting(mesh: jd.Mesh, **settings):
    """Return a problem, and targets that bend it."""
    handles = handles_of(mesh)
    problem = jd.precompute(mesh, handles, **settings)
    return problem, np.asarray(jd.bend(mesh.vertices[handles], 50.0, along="y"))


def plain(mesh):
    problem, targets = setting(mesh)
    out = jd.deform(problem, targets, 0.3)
    return out.vertices, out.transforms, out.energy[out.steps], out.flipped


def field_and_start_and_soft_handles(mesh):
    problem, targets = setting(mesh, cells=jd.rings(mesh, 2), handle_weights=2.0)
    field, start = 0.1 + 0.05 * mesh.vertices[:, 1], 1.01 * mesh.vertices
    settings = {"start": start, "handle_weights": 1.5, "solver": NO_SADDLES}
    return jd.deform(problem, targets, field, **settings).vertices


def with_normals(mesh):
    problem, targets = setting(mesh)
    return jd.deform(problem, targets, 1.0, normals=True, solver=jd.Alternating(10)).vertices


def gradient(mesh):
    problem, targets = setting(mesh)

    def height(targets, rigidity):
        out = jd.deform(problem, targets, rigidity, solver=NO_SADDLES)
        return jnp.sum(out.vertices[:, 1] ** 2)

    return jax.grad(height, argnums=(0, 1))(jnp.asarray(targets), jnp.asarray(0.5))


def unrolled_gradient(mesh):
    problem, targets = setting(mesh)
    solver = jd.Alternating(steps=5)

    def height(rigidity):
        return jnp.sum(jd.deform(problem, targets, rigidity, solver=solver).vertices[:, 1] ** 2)

    return jax.grad(height)(jnp.full(mesh.n_vertices, 0.5))


def gradient_to_rest(mesh):
    problem, targets = setting(mesh)

    def height(rest):
        out = jd.deform(problem, targets, 0.5, rest=rest, solver=NO_SADDLES)
        return jnp.sum(out.vertices[:, 1] ** 2)

    return jax.grad(height)(jnp.asarray(mesh.vertices))


def in_a_batch(mesh):
    problem, targets = setting(mesh)
    lam = np.full((3, mesh.n_vertices), [[0.1], [1.0], [10.0]])
    return jd.deform_batch(problem, targets, lam, start=mesh.vertices).vertices


def along_a_path(mesh):
    problem, targets = setting(mesh)
    rest = mesh.vertices[problem.handles]
    out = jd.deform_path(problem, [rest, 0.5 * (rest + targets), targets], 1.0)
    return out.vertices, out.flipped


def submesh(mesh):
    piece = jd.submesh(mesh, mesh.vertices[:, 1] > 3.0)
    problem = jd.precompute(piece.mesh, piece.handles, cells=piece.cells)
    targets = 1.1 * piece.mesh.vertices[piece.handles]
    return piece.reinsert(jd.deform(problem, targets, 1.0, solver=NO_SADDLES).vertices)


def editing(mesh):
    handles = handles_of(mesh)
    return jd.laplacian_editing(mesh, handles, jd.bend(mesh.vertices[handles], 50.0, along="y"))


def editing_with_similarity(mesh):
    handles = handles_of(mesh)
    targets = jd.bend(mesh.vertices[handles], 50.0, along="y")
    return jd.laplacian_editing(mesh, handles, targets, similarity=True, handle_weights=3.0)


def smooth_rotations(mesh):
    handles = handles_of(mesh)
    targets = jd.bend(mesh.vertices[handles], 50.0, along="y")
    return jd.sr_arap(mesh, handles, targets, steps=8).vertices


def minimality_and_energy(mesh):
    problem, targets = setting(mesh)
    out = jd.deform(problem, targets, 1.0)
    given = problem, targets, 1.0, out.vertices
    return jd.is_minimum(*given), jd.energy(problem, out.vertices, out.transforms, 1.0)


def constants(mesh):
    problem, _ = setting(mesh)
    return jd.rigidity_from_material(problem, 0.2)


def estimate(mesh):
    """From a pose with noise whose targets are known."""
    problem, targets = setting(mesh)
    out = jd.deform(problem, targets, 0.3)
    observed = np.asarray(out.vertices) + 1e-3 * np.sin(100.0 * mesh.vertices)
    fit = jd.estimate_rigidity(problem, observed, targets=targets)
    return fit.rigidity, fit.interval, np.asarray(fit.misfit)


def estimate_of_observed_handles(mesh):
    """The noise of the handles is probed with random numbers, which depend on the bucket."""
    problem, targets = setting(mesh)
    out = jd.deform(problem, targets, 0.3)
    wave = 1e-3 * np.sin(100.0 * mesh.vertices)
    return jd.estimate_rigidity(problem, np.asarray(out.vertices) + wave)


def estimate_of_a_field(mesh):
    """Its patterns are found by random numbers, which depend on the bucket, too."""
    problem, targets = setting(mesh)
    out = jd.deform(problem, targets, 0.1 + 0.05 * mesh.vertices[:, 1])
    settings = {"targets": targets, "smoothness": 1e-4, "max_evaluations": 3}
    return jd.estimate_rigidity_field(problem, out.vertices, **settings)


QUICK = [plain, with_normals, editing, constants, minimality_and_energy]
SLOW = [
    field_and_start_and_soft_handles,
    gradient,
    unrolled_gradient,
    gradient_to_rest,
    in_a_batch,
    along_a_path,
    submesh,
    editing_with_similarity,
    smooth_rotations,
    estimate,
]
CALLS = [*QUICK, *(pytest.param(call, marks=pytest.mark.slow) for call in SLOW)]


TRACED = [gradient, unrolled_gradient]


@pytest.fixture(scope="module")
def mesh() -> jd.Mesh:
    return tube(17)


@pytest.mark.parametrize("call", CALLS)
def test_what_fills_up_changes_nothing(call, mesh, monkeypatch):
    assert bucket(mesh.n_vertices) > mesh.n_vertices
    found = call(mesh)
    without_buckets(monkeypatch)
    want = call(mesh)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_single_precision(mesh, monkeypatch):
    """To what float32 tells apart."""
    problem, targets = setting(mesh, dtype=np.float32)
    found = jd.deform(problem, targets, 1.0).vertices
    without_buckets(monkeypatch)
    problem, targets = setting(mesh, dtype=np.float32)
    want = jd.deform(problem, targets, 1.0).vertices
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, want, atol=1e-3)


# Derivatives to the rest shape go edge by edge, and meshes of a bucket differ in their edges.
SHARED = [call for call in CALLS if gradient_to_rest not in getattr(call, "values", ())]
OF_ESTIMATES = [estimate_of_observed_handles, estimate_of_a_field]
SHARED += [pytest.param(call, marks=pytest.mark.slow) for call in OF_ESTIMATES]
# What JAX runs one by one while it traces an eager call: cutting off what fills up, the loss of
# these tests, and the transposes of both. No loop, no factor, no product with K.
CUT = {"slice", "dynamic_slice", "squeeze", "pad", "_pad", "convert_element_type"}
LOSS = {"broadcast_in_dim", "scatter", "mul", "integer_pow", "reduce_sum", "_reduce_sum"}


@pytest.mark.parametrize("call", SHARED)
def test_meshes_of_a_bucket_compile_once(call):
    meshes = [tube(rows) for rows in range(17, 21)]
    assert len({bucket(mesh.n_vertices) for mesh in meshes}) == 1
    call(meshes[-1])
    with compilations() as compiled:
        for mesh in meshes[:-1]:
            call(mesh)
    assert set(compiled) <= (CUT | LOSS if call in TRACED else set())


def with_pole(mesh: jd.Mesh) -> jd.Mesh:
    """Return a tube that a fan around one vertex closes."""
    pole = mesh.n_vertices
    rim = np.arange(AROUND)
    fan = np.stack([np.full(AROUND, pole), rim, (rim + 1) % AROUND], axis=1)
    return jd.Mesh([*mesh.vertices, [0.0, -0.5, 0.0]], [*mesh.faces, *fan])


def test_shapes_follow_the_number_of_vertices_not_their_valences():
    meshes = [tube(17), tube(20), with_pole(tube(18))]
    shapes = [
        jax.tree.map(lambda x: (x.shape, x.dtype), setting(mesh)[0].system) for mesh in meshes
    ]
    assert shapes[0] == shapes[1] == shapes[2]


def test_what_a_user_sees_has_its_own_size(mesh):
    problem, targets = setting(mesh)
    out = jd.deform(problem, targets, 1.0)
    assert out.vertices.shape == mesh.vertices.shape
    assert out.transforms.shape == (mesh.n_vertices, 3, 3)
    assert jd.rigidity_from_material(problem, 0.2).shape == (mesh.n_vertices,)


@dataclass(frozen=True)
class SimilarityFit:
    """A user's own law, which divides by tr(B)."""

    def minimize(self, c, b, rigidity):
        return _sized(jd.RotationFit().minimize(c, b, rigidity), c, b)

    def with_implicit_derivative(self, t, c, b, rigidity):
        return t

    def energy(self, t, c, b, rigidity):
        return jnp.sum(t**2 * b[None] - 2.0 * t * jnp.swapaxes(c, 0, 1), axis=(0, 1))


def _sized(rotation, c, b):
    size = jnp.sum(rotation * jnp.swapaxes(c, 0, 1), axis=(0, 1)) / jnp.sum(b, axis=0)
    return rotation * size[None, None]


@pytest.mark.parametrize("normals", [False, True])
def test_a_law_of_ones_own_sees_no_empty_cell(mesh, normals):
    """Where everything grows by a factor, a law of similarities fits exactly."""
    problem, _ = setting(mesh)
    rest = mesh.vertices[problem.handles]
    solver = jd.Alternating(300)
    out = jd.deform(problem, 1.5 * rest, 0.0, local=SimilarityFit(), solver=solver, normals=normals)
    assert np.isfinite(out.energy).all()
    if not normals:
        np.testing.assert_allclose(out.vertices, 1.5 * mesh.vertices, atol=1e-6)
