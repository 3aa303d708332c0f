"""A coarse start: cells as thin as the fine ones, handles exact, and the same minimum sooner."""

import igl
import jax
import numpy as np
import pytest
from helpers import ends

import jaxdeform as jd
from jaxdeform._deformation.coarse import _thinner

NEAR = 1e-4


def plate(n: int, width: float = 1.0) -> jd.Mesh:
    """Return a square plate of n by n vertices in the plane z = 0."""
    x, y = np.meshgrid(np.linspace(0, width, n), np.linspace(0, width, n), indexing="ij")
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (at[i : n - 1 + i, j : n - 1 + j].ravel() for i, j in np.ndindex(2, 2))
    faces = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)])
    return jd.Mesh(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), faces)


def energy(problem: jd.Problem, pose) -> float:
    """Return the energy of a pose, with cells that only turn."""
    settings = {"local": jd.RotationFit(), "solver": jd.Alternating(1)}
    out = jd.deform(problem, pose[problem.handles], 0.0, start=pose, **settings)
    return float(out.energy[0])


def rolled(mesh: jd.Mesh, radius: float) -> np.ndarray:
    """Roll the plane up along x: no length in the surface changes."""
    x, y, _ = mesh.vertices.T
    angle = x / radius
    return np.stack([radius * np.sin(angle), y, radius * (1 - np.cos(angle))], 1)


def pipe(around: int, along: int) -> jd.Mesh:
    """Return an open tube along y: 12 long, of radius 1."""
    vertices, faces = igl.cylinder(around, along)
    return jd.Mesh(vertices[:, [0, 2, 1]] * [1.0, 12.0, 1.0], faces)


@pytest.fixture(scope="module")
def tube() -> tuple[jd.Mesh, jd.Problem, np.ndarray]:
    mesh = pipe(40, 60)
    problem = jd.precompute(mesh, ends(mesh))
    return mesh, problem, np.asarray(jd.bend(mesh.vertices[problem.handles], 60.0))


def test_a_cell_is_thinner_where_it_bends_and_not_where_it_stretches():
    mesh = plate(16)
    problem = jd.precompute(mesh, [0])
    thin = _thinner(problem, 0.25)
    stretched = mesh.vertices * [1.3, 0.9, 1.0]
    # No edge bends: alpha has nothing to act on.
    both = [energy(p, stretched) for p in (problem, thin)]
    np.testing.assert_allclose(both[1], both[0], rtol=1e-9)
    # Of a plate that is rolled up, hardly anything is stretched: alpha times the energy.
    both = [energy(p, rolled(mesh, 2.0)) for p in (problem, thin)]
    np.testing.assert_allclose(both[1], 0.25 * both[0], rtol=0.02)


def test_a_coarse_plate_bends_like_the_fine_one():
    fine, coarse = plate(61), plate(16)
    problems = [jd.precompute(mesh, [0]) for mesh in (fine, coarse)]
    at = [energy(p, rolled(p.mesh, 2.0)) for p in problems]
    assert at[1] > 10 * at[0]  # as it is, sixteen times as stiff
    thin = _thinner(problems[1], (15 / 60) ** 2)
    got = energy(thin, rolled(coarse, 2.0))
    np.testing.assert_allclose(got, at[0], rtol=0.1)  # at the borders, cells differ


@pytest.mark.parametrize(
    "local",
    [jd.Newton(), pytest.param(jd.RotationFit(), marks=pytest.mark.slow)],
    ids=["material", "arap"],
)
def test_the_same_minimum_with_fewer_evaluations(tube, local):
    mesh, problem, targets = tube
    rigidity = jd.rigidity_from_material(problem, 10.0)
    coarse = jd.coarsen(problem, 300)
    start = coarse.start(targets, rigidity, local=local)
    solver = jd.QuasiNewton(1e-10, leave_saddles=False)
    ours, plain = (
        jd.deform(problem, targets, rigidity, start=at, local=local, solver=solver)
        for at in (start, None)
    )
    least = float(plain.energy[-1])
    assert bool(ours.ok)
    np.testing.assert_allclose(float(ours.energy[-1]), least, rtol=1e-7)
    assert np.abs(ours.vertices - plain.vertices).max() < 1e-3 * mesh.diagonal
    steps = [int(np.argmax(np.asarray(x.energy) <= least * (1 + NEAR))) for x in (ours, plain)]
    assert steps[0] < 0.75 * steps[1]
    assert float(ours.energy[0]) < 1.5 * least < 0.2 * float(plain.energy[0])


def test_a_rigid_motion_is_followed_exactly(tube):
    mesh, problem, _ = tube
    moved = jd.rotate(mesh.vertices, 50.0, axis=[1.0, 2.0, 0.5])
    moved = np.asarray(jd.translate(moved, [3.0, 0.0, -1.0]))
    start = jd.coarsen(problem, 300).start(moved[problem.handles], 1.0)
    assert np.abs(start - moved).max() < 1e-5 * mesh.diagonal  # the tolerance of the coarse one


@pytest.mark.slow
def test_handles_are_exact_and_components_stay_apart():
    """A small component next to a large one, a vertex in no face, soft and single handles."""
    big, small = pipe(24, 40), jd.shapes.bar()
    size = 0.02 * big.diagonal / small.diagonal
    beside = (small.vertices - small.center) * size + big.vertices[100] + [0.05, 0.0, 0.0]
    n = big.n_vertices
    vertices = np.concatenate([big.vertices, beside, [[9.0, 9.0, 9.0]]])
    mesh = jd.Mesh(vertices, np.concatenate([big.faces, small.faces + n]))
    handles = np.concatenate([ends(big)[::7], [n + 5, len(vertices) - 1]])
    weights = np.where(np.arange(len(handles)) % 3 == 1, 2.0, np.inf)
    weights[-2:] = np.inf
    problem = jd.precompute(mesh, handles, handle_weights=weights)
    targets = mesh.vertices[handles] + [0.0, 1.0, 0.0]
    targets[-2] = mesh.vertices[n + 5] - [0.0, 2.0, 0.0]
    coarse = jd.coarsen(problem, 300)
    start = np.asarray(coarse.start(targets, 1.0))
    np.testing.assert_allclose(
        start[handles[np.isinf(weights)]], targets[np.isinf(weights)], atol=1e-9
    )
    # Each component goes where its own handles go.
    for part, at, move in ((slice(n), big.vertices, 1.0), (slice(n, -1), beside, -2.0)):
        moved = jd.translate(at, [0.0, move, 0.0])
        np.testing.assert_allclose(start[part], moved, atol=1e-4 * mesh.diagonal)
    # Soft handles that one coarse vertex stands for pull together.
    soft = np.asarray(coarse.coarse.system.soft).sum()
    assert 0 < soft <= weights[np.isfinite(weights)].sum()


@pytest.mark.slow
def test_under_jit_and_vmap(tube):
    _, problem, targets = tube
    coarse = jd.coarsen(problem, 300)
    batch = np.stack([targets, jd.translate(targets, [0.0, 0.2, 0.0])])
    both = jax.jit(jax.vmap(lambda t, r: coarse.start(t, r)))(batch, np.array([0.1, 1.0]))
    for k, rigidity in enumerate((0.1, 1.0)):
        alone = coarse.start(batch[k], rigidity)
        np.testing.assert_allclose(both[k], alone, atol=1e-4)


@pytest.mark.slow
def test_float32_and_a_field_of_rigidity(tube):
    mesh, problem, targets = tube
    field = np.where(mesh.vertices[:, 1] < 6, 0.01, 5.0)
    wide = jd.coarsen(problem, 300).start(targets, field)
    narrow = jd.precompute(mesh, problem.handles, dtype=np.float32)
    got = jd.coarsen(narrow, 300).start(targets.astype(np.float32), field)
    assert got.dtype == np.float32
    assert np.abs(np.asarray(got) - np.asarray(wide)).max() < 0.02 * mesh.diagonal


def test_faces_that_disagree_about_the_side_are_turned(tube):
    mesh, problem, targets = tube
    faces = mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    mixed = jd.precompute(jd.Mesh(mesh.vertices, faces), problem.handles)
    starts = [jd.coarsen(p, 300).start(targets, 1.0) for p in (problem, mixed)]
    assert np.abs(starts[0] - starts[1]).max() < 0.05 * mesh.diagonal


def test_what_cannot_be_made_coarse():
    bar = jd.shapes.bar()
    problem = jd.precompute(bar, ends(bar))
    with pytest.raises(jd.InputError, match=r"n_vertices is 722, .* the mesh has 722"):
        jd.coarsen(problem, 722)
    with pytest.raises(jd.InputError, match="outside of jit"):
        jax.jit(lambda p: jd.coarsen(p, 100).rows)(problem)
    fan = jd.Mesh(
        np.eye(5, 3) + np.arange(15).reshape(5, 3) ** 2, [[0, 1, 2], [0, 1, 3], [0, 1, 4]]
    )
    with pytest.raises(jd.InputError, match="a coarse mesh needs a manifold surface"):
        jd.coarsen(jd.precompute(fan, [0]), 4)
    # A Moebius band: libigl's decimation ends the process.
    n, w = 40, 4
    t, s = np.meshgrid(2 * np.pi * np.arange(n) / n, np.linspace(-0.3, 0.3, w), indexing="ij")
    r = 1 + s * np.cos(t / 2)
    points = np.stack([r * np.cos(t), r * np.sin(t), s * np.sin(t / 2)], -1).reshape(-1, 3)
    at = np.arange(n * w).reshape(n, w)
    after = np.concatenate([at[1:], at[:1, ::-1]])
    a, b, c, d = (x.ravel() for x in (at[:, :-1], at[:, 1:], after[:, :-1], after[:, 1:]))
    band = jd.Mesh(points, np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)]))
    with pytest.raises(jd.InputError, match="two sides"):
        jd.coarsen(jd.precompute(band, [0]), 50)
