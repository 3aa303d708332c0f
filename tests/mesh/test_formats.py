"""OBJ, OFF, PLY and STL as other programs write them."""

import igl
import numpy as np
import pytest
from helpers import CASES, EXACT
from small_files import ONE_FACET, PLY, SUFFIXES

import jaxdeform as jd


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_libigl_reads_what_we_write(tmp_path, odd, suffix):
    path = tmp_path / f"m{suffix}"
    jd.save_mesh(path, odd)
    v, f = igl.read_triangle_mesh(str(path))
    rtol = 1e-6 if suffix == ".stl" else EXACT  # STL is single precision
    np.testing.assert_allclose(v[f], odd.vertices[odd.faces], rtol=rtol)


@pytest.mark.parametrize("encoding", [igl.FileEncoding.Binary, igl.FileEncoding.Ascii])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_we_read_what_libigl_writes(tmp_path, odd, suffix, encoding):
    path = tmp_path / f"m{suffix}"
    igl.write_triangle_mesh(str(path), odd.vertices, np.asarray(odd.faces), encoding)
    back = jd.load_mesh(path)
    # libigl writes text with six digits or more.
    corners = back.vertices[back.faces]
    np.testing.assert_allclose(corners, odd.vertices[odd.faces], rtol=1e-5)


def test_stl_keeps_single_precision_and_joins_equal_corners(tmp_path, bar):
    jd.save_mesh(tmp_path / "bar.stl", bar)
    back = jd.load_mesh(tmp_path / "bar.stl")
    assert (back.n_vertices, back.n_faces) == (722, 1440)
    single = bar.vertices.astype(np.float32)
    np.testing.assert_array_equal(back.vertices[back.faces], single[bar.faces])


@pytest.mark.parametrize(
    ("flags", "prefix"), [("property float area", "7 "), ("property list uchar int t", "2 8 9 ")]
)
def test_ply_properties_in_any_order(tmp_path, flags, prefix):
    path = tmp_path / "m.ply"
    text = PLY.format(flags=flags, first=prefix + "3 0 1 2", second=prefix + "3 0 2 3")
    path.write_text(text)
    mesh = jd.load_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert jd.load_rigidity(path).tolist() == [0.5, 1.5, 2.5, 3.5]


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_of_both_byte_orders_with_further_lists(tmp_path, order):
    vertex = np.dtype([("x", order + "f4"), ("y", order + "f4"), ("z", order + "f8")])
    face = np.dtype(
        [("n", "u1"), ("uv", order + "f4", (6,)), ("m", order + "u4"), ("f", order + "i2", (3,))]
    )
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0.1)], vertex)
    faces = np.array([(6, np.arange(6), 3, [2, 0, 1])], face)
    head = f"""ply
format binary_{"little" if order == "<" else "big"}_endian 1.0
element vertex 3
property float x
property float y
property double z
element face 1
property list uchar float texcoord
property list uint short vertex_indices
end_header
"""
    path = tmp_path / "m.ply"
    path.write_bytes(head.encode() + vertices.tobytes() + faces.tobytes())
    mesh = jd.load_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0.1]]
    assert mesh.faces.tolist() == [[2, 0, 1]]


def test_dialects(tmp_path):
    texts = {
        "counts.off": "\ufeffOFF 3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2",
        "comments.off": "# by hand\nOFF\n\n3 1 0 # counts\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n",
        "colours.off": "COFF\n3 1 0\n0 0 0 9 9 9 9\n1 0 0 9 9 9 9\n0 1 0 9 9 9 9\n3 0 1 2\n",
        "windows.off": "OFF\r\n3 1 0\r\n0 0 0\r\n1 0 0\r\n0 1 0\r\n3 0 1 2\r\n",
        "full.obj": "o x\nv 0 0 0 1\nv 1 0 0\nvt 0 0\nvn 0 0 1\nv 0 1 0\ns off\nf 1/1/1 2//1 3/1\n",
        "back.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 9 9 9\n",
        "spaces.off": " \n\t OFF # by hand\n # counts\n 3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n\n \n",
        "upper.obj": "V 0 0 0\nV 1 0 0\nVT 0 0\nV 0 1 0\nUSEMTL a\nF 1/1 2/1 3/1\n",
        "goes_on.obj": "v 0 0 \\\r\n 0\r\nv 1 0 0 # C:\\\r\nv 0 1 0\r\nf \\ \r\n1 2 \\\r\n3\r\n",
        "mark.obj": "\ufeffv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "mark.stl": "\ufeff" + ONE_FACET,
        "text.stl": """solid a#b
 facet normal 0 0 1
  outer loop
   vertex 0 0 0
   vertex 1 0 -0.0
   vertex 0 1 0
  endloop
 endfacet
endsolid a#b""",
    }
    for name, text in texts.items():
        (tmp_path / name).write_bytes(text.encode())
        mesh = jd.load_mesh(tmp_path / name)
        assert mesh.vertices[mesh.faces[0]].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]], name
        assert mesh.n_faces == 1


OCTAHEDRON = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1.0]]) + 0.1
EIGHT = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]]


@pytest.mark.parametrize(
    "name",
    [
        "03_seams_vt_vn.obj",
        "07_colors_w.obj",
        "10_line_continuation.obj",
        "46_upper_crlf.stl",
        "47_binary_trailing_bytes.stl",
    ],
)
def test_files_of_other_programs(name):
    mesh = jd.load_mesh(CASES / name)
    assert (mesh.n_vertices, mesh.n_faces) == (6, 8)
    rtol = 1e-6 if name.startswith("47") else EXACT  # single precision
    np.testing.assert_allclose(mesh.vertices[mesh.faces], OCTAHEDRON[EIGHT], rtol=rtol)


def test_ply_header_lines_may_end_in_cr():
    mesh = jd.load_mesh(CASES / "48_cr_line_ends.ply")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_a_binary_body_may_begin_with_a_line_feed(tmp_path, end):
    """The byte behind the header belongs to the first number, whatever it looks like."""
    ten = np.frombuffer(b"\n\r\n\r", "<f4")[0]
    points = np.array([[ten, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    lines = ["PLY", "Format binary_little_endian 1.0", "ELEMENT vertex 3"]
    lines += [f"property FLOAT {axis}" for axis in "xyz"]
    lines += ["comment end_header", "element face 1", "property list uchar int vertex_index"]
    head = end.join(line.encode() for line in [*lines, "end_header"]) + end
    face = b"\3" + np.arange(3, dtype="<i4").tobytes()
    path = tmp_path / "m.ply"
    path.write_bytes(head + points.tobytes() + face)
    np.testing.assert_array_equal(jd.load_mesh(path).vertices, points)


def test_triangle_strips():
    mesh = jd.load_mesh(CASES / "37_tristrips.ply")
    # The second triangle is turned over, so that both face the same way.
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 1, 3]]


def test_strips_end_at_minus_one_and_turn_corners_by_repeating(tmp_path):
    body = "9 0 1 2 3 -1 1 0 4 4\n4 3 2 1 0\n"
    text = (CASES / "37_tristrips.ply").read_text().replace("vertex 4", "vertex 5")
    text = text.replace("tristrips 1", "tristrips 2").replace("4 0 1 2 3\n", "0 0 5\n" + body)
    path = tmp_path / "m.ply"
    path.write_text(text)
    want = [[0, 1, 2], [2, 1, 3], [1, 0, 4], [3, 2, 1], [1, 2, 0]]
    assert jd.load_mesh(path).faces.tolist() == want


def test_a_ply_may_have_its_faces_first(tmp_path):
    path = tmp_path / "m.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
        "element vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "3 0 1 2\n0 0 0\n1 0 0\n0 1 0\n"
    )
    assert jd.load_mesh(path).vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply"])
def test_a_georeferenced_scan_loses_no_digit(tmp_path, suffix):
    rng = np.random.default_rng(3)
    v = np.array([412_345.678, 5_654_321.123, 87.5]) + rng.integers(0, 1000, (3, 3)) / 1000
    jd.save_mesh(tmp_path / f"m{suffix}", jd.Mesh(v, [[0, 1, 2]]))
    assert jd.load_mesh(tmp_path / f"m{suffix}").vertices.tobytes() == v.tobytes()


PLY_HEAD = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int64 vertex_indices
end_header
"""
FLOWING = {
    "one.off": "OFF 3 1 0 0 0 0 1 0 0 0 1 0 3 0 1 2",
    "two.off": "OFF # by hand\n3 1 3\n0 0 0 1 0 0\n0 1\n0 3 0\n1 2\n",
    "normals.off": "NOFF 3 1 0 0 0 0 0 0 1 1 0 0 0 0 1 0 1 0 0 0 1 3 0 1 2",
    "one.ply": PLY_HEAD + "0 0 0 1 0 0 0 1 0 3 0 1 2",
    "two.ply": PLY_HEAD + "0 0\n0 1 0 0\n0 1 0 3\n0 1\n2\n",
}


@pytest.mark.parametrize("name", FLOWING)
def test_records_need_not_have_lines_of_their_own(tmp_path, name):
    path = tmp_path / name
    path.write_text(FLOWING[name])
    mesh = jd.load_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2]]
    out = tmp_path / f"out{path.suffix}"
    jd.save_mesh(out, mesh)
    assert out.read_bytes() == path.read_bytes()
    jd.save_mesh(out, mesh, vertices=mesh.vertices + 1)
    assert jd.load_mesh(out).vertices.tolist() == [[1, 1, 1], [2, 1, 1], [1, 2, 1]]
    # Less of it is no other mesh.
    for size in range(len(FLOWING[name].rstrip()) - 1):
        path.write_text(FLOWING[name][:size])
        with pytest.raises(jd.InputError):
            jd.load_mesh(path)


@pytest.mark.parametrize(
    ("name", "text", "behind"),
    [
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "\0\0"),
        ("m.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "\0\0"),
        ("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "\x1a"),
        ("m.stl", ONE_FACET, "\0\0"),
        ("m.stl", ONE_FACET, "made by hand\n"),
    ],
)
def test_what_stands_behind_the_end_of_a_text(tmp_path, name, text, behind):
    path = tmp_path / name
    path.write_text(text + behind)
    mesh = jd.load_mesh(path)
    assert mesh.vertices[mesh.faces[0]].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    jd.save_mesh(path, mesh, vertices=mesh.vertices + 1)
    assert path.read_text().endswith(behind)
    assert jd.load_mesh(path).vertices.tolist() == (mesh.vertices + 1).tolist()


@pytest.mark.parametrize("kind", ["int64", "uint64"])
def test_binary_ply_with_wide_integers(tmp_path, kind):
    head = PLY_HEAD.replace("ascii", "binary_little_endian").replace("int64", kind)
    path = tmp_path / "m.ply"
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    path.write_bytes(head.encode() + points.tobytes() + b"\3" + np.arange(3, dtype="<i8").tobytes())
    assert jd.load_mesh(path).faces.tolist() == [[0, 1, 2]]
