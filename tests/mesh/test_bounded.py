"""Which cells have an energy without a lower bound, by brute force on dense matrices."""

import numpy as np
import pytest
from helpers import bumpy_sheet, real_mesh

import jaxdeform as jd
from jaxdeform._mesh.bounded import bounded_cells, unbounded_cells


def needle_terrain(seed: int) -> jd.Mesh:
    """Return the sheet with its vertices pushed about in the plane, so that angles are obtuse."""
    mesh = bumpy_sheet()
    push = np.random.default_rng(seed).uniform(-0.45, 0.45, mesh.vertices.shape)
    return jd.Mesh(mesh.vertices + push, mesh.faces)


def joint_form(cells: jd.Cells, k: int) -> np.ndarray:
    """Return the form ``sum_e w_e |p_i - p_j - T e|^2`` of cell k, in one row of p and of T."""
    mesh, edges = cells.mesh, cells.membership[k].indices
    form = np.zeros((mesh.n_vertices + 3,) * 2)
    for e in edges:
        i, j = mesh.edges[e]
        row = np.zeros(len(form))
        row[i], row[j] = 1.0, -1.0
        row[-3:] = -(mesh.vertices[i] - mesh.vertices[j])
        form += cells.weights[e] * np.outer(row, row)
    return form


def brute_force(cells: jd.Cells) -> list[int]:
    forms = (joint_form(cells, k) for k in range(cells.n_vertices))
    lowest = [np.linalg.eigvalsh(form)[[0, -1]] for form in forms]
    return [k for k, (low, high) in enumerate(lowest) if low < -1e-9 * max(high, 1e-300)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["spokes", "rings", "two rings"])
def test_the_unbounded_cells_are_those_of_brute_force(seed, kind):
    mesh = needle_terrain(seed)
    make = {"spokes": jd.spokes, "rings": jd.rings, "two rings": lambda m: jd.rings(m, 2)}
    cells = make[kind](mesh)
    want = brute_force(cells)
    assert unbounded_cells(cells).tolist() == want
    mended, bad = bounded_cells(cells)
    assert bad.tolist() == want
    assert brute_force(mended) == []
    changed = mended.weights != cells.weights
    assert (cells.weights[changed] < 0).all()
    assert (mended.weights[changed] == 0).all()


def test_no_negative_weight_is_no_work():
    cells = jd.rings(jd.shapes.bar())
    assert unbounded_cells(cells).size == 0
    assert bounded_cells(cells)[0] is cells


def test_few_cells_of_real_meshes_are_without_a_bound():
    for name, most in (("octopus_10173.off", 0.01), ("decimated-knight.off", 0.1)):
        mesh = real_mesh(name)
        bad = unbounded_cells(jd.rings(mesh))
        assert 0 < len(bad) < most * mesh.n_vertices
        assert unbounded_cells(bounded_cells(jd.rings(mesh))[0]).size == 0


@pytest.mark.slow
def test_precompute_names_the_cells_and_the_energy_stays_bounded():
    """Without the bound, this deformation ended at an energy of -1.4e150, and said 'Converged'."""
    mesh = real_mesh("decimated-knight.off")
    y = mesh.vertices[:, 1]
    low, high = np.quantile(y, [0.1, 0.9])
    handles = np.flatnonzero((y < low) | (y > high))
    with pytest.warns(UserWarning, match=r"27 cells without a lower bound \(cells \d+, "):
        problem = jd.precompute(mesh, handles)
    top = mesh.vertices[handles][:, 1] > high
    size = np.ptp(mesh.vertices, axis=0).max()
    targets = mesh.vertices[handles] + top[:, None] * np.array([0.15, 0.1, 0.0]) * size
    for rigidity in (0.0, 1e-12, 1e-4):
        out = jd.deform(problem, targets, rigidity, solver=jd.QuasiNewton(max_steps=2000))
        assert float(out.energy[-1]) > -1e-9 * float(out.energy[0])
        assert np.abs(np.asarray(out.vertices) - mesh.vertices).max() < size


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.filterwarnings("ignore:negative weights")
def test_weights_of_which_none_is_positive_are_refused_as_such(bar, value):
    cells = jd.rings(bar, 1, weights=np.full(len(bar.edges), value))
    with pytest.raises(jd.InputError, match="none of their 2160 edge weights is positive, so"):
        jd.precompute(bar, [0, 721], cells=cells)
    # Where every vertex is a handle, nothing has to hold the others.
    assert jd.precompute(bar, np.arange(722), cells=cells).n_vertices == 722
