"""Jobs of each method give what its own function gives, one after the other on one mesh."""

import json

import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._apps.batch.manifest import read_manifest
from jaxdeform._apps.batch.work import do


@pytest.fixture
def done(tmp_path, bar):
    """Return a function that does jobs that lift the upper end of a bar 1 high, given the rest."""
    jd.save_mesh(tmp_path / "bar.off", jd.Mesh(bar.vertices / 151, bar.faces))

    def done(*rows):
        held = {"mesh": "bar.off", "fix": "v < 0.1", "move": "v > 0.9", "translate": [0.3, 0.2, 0]}
        lines = [json.dumps({"job": f"job {k}"} | held | row) for k, row in enumerate(rows)]
        (tmp_path / "jobs.jsonl").write_text("\n".join(lines))
        found = [do(job) for job in read_manifest(tmp_path / "jobs.jsonl")]
        assert [one.result for one in found] == ["converged"] * len(rows)
        return [one.vertices for one in found]

    return done


@pytest.fixture
def lifted(tmp_path, done):
    """Return the mesh, its handles, and where they are after a share of the motion."""
    mesh = jd.load_mesh(tmp_path / "bar.off")
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 0.1) | (y > 0.9))
    up = np.outer(y[handles] > 0.9, [0.3, 0.2, 0.0])
    return mesh, handles, lambda share: mesh.vertices[handles] + share * up


@pytest.mark.parametrize("method", ["arap", "rc-arap"])
def test_methods_of_the_engine(done, lifted, method):
    mesh, handles, targets = lifted
    own = {"method": method} | ({"rings": 2} if method == "rc-arap" else {})
    one, last = done(own, own | {"frames": 2})
    cells = jd.spokes(mesh) if method == "arap" else jd.rings(mesh, 2)
    problem, local = jd.precompute(mesh, handles, cells=cells), jd.RotationFit()
    want = jd.deform(problem, targets(1.0), 0.0, local=local)
    np.testing.assert_allclose(one, want.vertices, atol=1e-8)
    want = jd.deform_path(problem, [targets(0.5), targets(1.0)], 0.0, local=local)
    np.testing.assert_allclose(last, want.vertices[-1], atol=1e-8)


def test_smooth_rotations(done, lifted):
    mesh, handles, targets = lifted
    usual = {"method": "sr-arap"}
    one, last, looser = done(usual, usual | {"frames": 2}, usual | {"alpha": 0.002})
    np.testing.assert_allclose(one, jd.sr_arap(mesh, handles, targets(1.0)).vertices, atol=1e-8)
    first = jd.sr_arap(mesh, handles, targets(0.5)).vertices
    want = jd.sr_arap(mesh, handles, targets(1.0), start=first)
    np.testing.assert_allclose(last, want.vertices, atol=1e-8)
    want = jd.sr_arap(mesh, handles, targets(1.0), 0.002)
    np.testing.assert_allclose(looser, want.vertices, atol=1e-8)
    assert np.abs(looser - one).max() > 1e-3
