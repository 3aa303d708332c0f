"""A piece deforms as it would within the whole."""

import copy
import pickle

import numpy as np
import pytest
from helpers import TWENTY, relative

import jaxdeform as jd


def test_a_copy_is_the_same_and_cannot_be_written(bar):
    piece = jd.submesh(bar, bar.vertices[:, 1] > 100.0)
    for one in (piece, pickle.loads(pickle.dumps(piece)), copy.deepcopy(piece), copy.copy(piece)):
        assert one.mesh == piece.mesh
        assert one.whole == bar
        for name in ("handles", "index"):
            np.testing.assert_array_equal(getattr(one, name), getattr(piece, name))
            with pytest.raises(ValueError, match="read-only"):
                getattr(one, name)[0] = 5


@pytest.mark.slow
def test_the_submesh_is_the_whole(bar):
    mesh = jd.shapes.cactus()
    free = np.flatnonzero((mesh.vertices[:, 0] > 0.9) & (mesh.vertices[:, 1] < 3.1))
    fixed = np.setdiff1d(np.arange(mesh.n_vertices), free)
    positions = mesh.vertices.copy()
    tip = (mesh.vertices[:, 0] > 0.9) & (mesh.vertices[:, 1] >= 3.1)
    positions[tip] += [0.3, -0.2, 0.4]
    rng = np.random.default_rng(2)
    cells = jd.rings(mesh, rng.integers(1, 3, mesh.n_vertices))
    rigidity = rng.uniform(0.01, 0.5, mesh.n_vertices)
    whole = jd.precompute(mesh, fixed, cells=cells)
    want = jd.deform(whole, positions[fixed], rigidity, solver=TWENTY)
    part = jd.submesh(mesh, free, cells)
    assert part.mesh.n_vertices < 0.3 * mesh.n_vertices
    problem = jd.precompute(part.mesh, part.handles, cells=part.cells)
    out = jd.deform(
        problem,
        positions[part.index][part.handles],
        rigidity[part.index],
        solver=TWENTY,
    )
    assert relative(part.reinsert(out.vertices, positions), want.vertices) < 1e-9
