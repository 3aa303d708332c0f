"""The work of reading a file is in proportion to its size, also where the file is odd."""

import gzip
import time
import zlib

import numpy as np
import pytest

import jaxdeform as jd
from jaxdeform._mesh import ears, polygons

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def test_compressed_files_of_many_members(tmp_path, monkeypatch):
    """Two members of 100 bytes and 20,000 more, as programs leave them that write in pieces."""
    body = TRIANGLE + b"f 1 2 3\n"
    path = tmp_path / "m.obj.gz"
    comment = gzip.compress(b"#" * 99 + b"\n")
    path.write_bytes(gzip.compress(body) + b"\0" * 9 + 20_000 * comment + b"\0" * 9)
    taken = []
    real = zlib.decompressobj

    class Counted:
        def __init__(self, wbits):
            self.member = real(wbits=wbits)

        def decompress(self, piece, most):
            taken.append(len(piece))
            return self.member.decompress(piece, most)

        def __getattr__(self, name):
            return getattr(self.member, name)

    monkeypatch.setattr(zlib, "decompressobj", Counted)
    assert jd.load_mesh(path).n_faces == 1
    # Each member is 25 bytes, and a piece that is read may hold ten of them.
    assert sum(taken) < 12 * path.stat().st_size


def test_a_large_member_is_read_once(tmp_path):
    noise = np.random.default_rng(0).integers(97, 123, 300_000).astype(np.uint8).tobytes()
    path = tmp_path / "m.obj.gz"
    path.write_bytes(2 * gzip.compress(b"#" + noise + b"\n") + gzip.compress(TRIANGLE + b"f 1 2 3"))
    assert jd.load_mesh(path).n_faces == 1


def test_a_polygon_that_winds_many_times_is_not_searched_for_ears(tmp_path, monkeypatch):
    """Its triangles overlap, however it is cut."""
    monkeypatch.setattr(polygons, "cut_ears", lambda _: pytest.fail("searched"))
    path = tmp_path / "m.obj"
    path.write_bytes(TRIANGLE + 20 * (b"f " + 666 * b"1 2 3 " + b"\n"))
    with pytest.raises(jd.InputError, match=r"face 1 \[0, 2, 0\] repeats a vertex"):
        jd.load_mesh(path)


def test_a_hole_cut_open_has_as_many_corners_as_can_be(tmp_path):
    """The rim goes in and back between the same vertices; 2 d - 5 triangles need a triangle."""
    angle = np.arange(40) * 2 * np.pi / 40
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    points = np.concatenate([2 * circle, circle])
    rim = [*range(40), 0, 40, *range(79, 39, -1)]
    path = tmp_path / "m.obj"
    lines = ["v " + " ".join(map(repr, row)) for row in points.tolist()]
    path.write_text("\n".join([*lines, "f " + " ".join(str(k + 1) for k in rim)]))
    mesh = jd.load_mesh(path)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas > 0).all()
    np.testing.assert_allclose(areas.sum(), 3 * 20 * np.sin(2 * np.pi / 40), rtol=1e-9)


@pytest.mark.parametrize("least", [0.1, 1.0])
def test_a_polygon_of_thousands_of_corners(monkeypatch, least):
    """Star-shaped or convex: a few tests of each corner find all triangles."""
    n = 5_000
    tests = []
    covers = ears._covers
    monkeypatch.setattr(ears, "_covers", lambda *given: tests.append(0) or covers(*given))
    angle = np.arange(n) * 2 * np.pi / n
    radius = np.random.default_rng(0).uniform(least, 1, n)
    flat = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    faces = ears.cut_ears(flat)
    u, v = flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]]
    areas = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    assert (areas > 0).all()
    x, y = flat.T
    border = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    np.testing.assert_allclose(areas.sum(), border, rtol=1e-9)
    assert len(tests) < 4 * n


def test_a_line_that_goes_on_a_million_times(tmp_path):
    """It takes 1.5 s of the processor; with a copy of the line for each piece it took 35."""
    path = tmp_path / "m.obj"
    path.write_bytes(TRIANGLE + b"f 1 2 " + 1_000_000 * b"\\\n" + b"3\n")
    began = time.process_time()
    assert jd.load_mesh(path).n_faces == 1
    assert time.process_time() - began < 15
