"""Mesh files, checks, mending and inspection, against brute force."""

import os
import stat
from collections import Counter
from pathlib import Path

import igl
import numpy as np
import pytest
from conftest import EXACT, real_mesh
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxdeform as jd
from jaxdeform._mesh.files import write_beside

SUFFIXES = (".obj", ".off", ".ply", ".stl")


@pytest.fixture
def odd():
    """An open strip whose coordinates need all their bits."""
    v = np.random.default_rng(0).normal(size=(8, 3)) * [1e-7, 1.0, 1e7]
    return jd.Mesh(v, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6], [5, 7, 6]])


def tetrahedron(offset=0.0):
    v = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + offset
    return v, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


# ---------------------------------------------------------------- round trips


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".OFF"])
def test_a_written_mesh_is_read_back_bit_for_bit(tmp_path, odd, suffix):
    jd.save_mesh(tmp_path / f"m{suffix}", odd)
    back = jd.load_mesh(tmp_path / f"m{suffix}")
    assert back.vertices.tobytes() == odd.vertices.tobytes()
    np.testing.assert_array_equal(back.faces, odd.faces)


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


def test_rigidity_goes_with_a_ply(tmp_path, odd):
    values = np.random.default_rng(1).random(8)
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd, vertices=odd.vertices + 1, rigidity=values)
    assert jd.load_rigidity(path).tobytes() == values.tobytes()
    np.testing.assert_array_equal(jd.load_mesh(path).vertices, odd.vertices + 1)
    jd.save_mesh(path, odd, rigidity=3)
    np.testing.assert_array_equal(jd.load_rigidity(path), np.full(8, 3.0))
    jd.save_mesh(path, odd)
    with pytest.raises(jd.InputError, match="no property 'rigidity'"):
        jd.load_rigidity(path)
    with pytest.raises(jd.InputError, match=r"\.ply files only"):
        jd.load_rigidity(tmp_path / "m.off")


PLY = """ply
format ascii 1.0
comment by hand
element vertex 4
property float rigidity
property double x
property float y
property float z
property uchar red
element face 2
{flags}
property list uchar int vertex_index
element edge 1
property int a
end_header
0.5 0 0 0 255
1.5 1 0 0 255
2.5 1 1 0 255
3.5 0 1 0 255
{first}
{second}
0
"""


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


# ---------------------------------------------------------------- bad input


def test_bad_arrays_are_named():
    v, f = tetrahedron()
    bad = {
        r"vertex 2 is \[0.0, nan, 0.0\] \(1 such\): give finite": (_set(v, (2, 1), np.nan), f),
        r"vertex 0 is \[inf": (_set(v, (0, 0), np.inf), f),
        r"face 1 \[0, 1, 4\] names a vertex out of range": (v, _set(f, (1, 2), 4)),
        r"face 3 \[-1, 3, 2\]": (v, _set(f, (3, 0), -1)),
        r"face 2 \[1, 1, 3\] repeats a vertex: drop": (v, _set(f, (2, 1), 1)),
        r"face 0 \[0, 2, 1\] has no area: drop": (_set(v, 2, [2, 0, 0]), f),
        r"vertices have shape \(4, 2\)": (v[:, :2], f),
        r"vertices have shape \(0,\)": ([], f),
        r"faces have shape \(0,\)": (v, []),
        r"faces have shape \(1, 4\)": (v, [[0, 1, 2, 3]]),
        "faces must be integers, got float64": (v, f * 1.0),
        "faces are no table": (v, [[0, 1, 2], [0, 1]]),
        "vertices cannot be read as numbers": ([["a", "b", "c"]], f),
    }
    for message, (vertices, faces) in bad.items():
        with pytest.raises(jd.InputError, match=message) as error:
            jd.Mesh(vertices, faces)
        assert "\n" not in str(error.value)


def _set(array, at, value):
    out = np.array(array)
    out[at] = value
    return out


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_what_has_no_area_does_not_depend_on_the_unit(scale):
    thin = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]])
    jd.Mesh(scale * thin, [[0, 1, 2]])
    flat = np.array([[0, 0, 0], [1, 1, 1], [3, 3, 3]]) / 3
    with pytest.raises(jd.InputError, match="no area"):
        jd.Mesh(scale * flat, [[0, 1, 2]])


def test_the_caller_s_arrays_are_copied_and_the_mesh_s_are_frozen():
    v, f = tetrahedron()
    mesh = jd.Mesh(v, f)
    v[:] = 7
    assert mesh.vertices[1].tolist() == [1, 0, 0]
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1
    with pytest.raises(AttributeError):
        mesh.faces = f


BAD_FILES = {
    "empty.off": (b"", "is empty"),
    "blank.obj": (b" \n\n", "is empty"),
    "comment.off": (b"# OFF\n", "does not start with OFF"),
    "other.off": (b"hello", "does not start with OFF"),
    "four.off": (b"4OFF\n1 0 0\n0 0 0 1\n", "does not start with OFF"),
    "counts.off": (b"OFF\nthree 1 0\n", "no counts"),
    "negative.off": (b"OFF\n-3 1 0\n0 0 0\n", "holds fewer"),
    "short.off": (b"OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "holds fewer"),
    "word.off": (b"OFF\n3 1 0\n0 0 x\n1 0 0\n0 1 0\n3 0 1 2\n", "'0 0 x' is no vertex"),
    "two.off": (b"OFF\n3 1 0\n0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "'0 0' is no vertex"),
    "nan.off": (b"OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n", r"nan.off: vertex 0 is"),
    "range.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", r"range.off: face 0 \[0, 1, 3\]"),
    "flat.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n", "flat.off: face 0 .* no area"),
    "quad.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2 0\n", "face 0 is a polygon with 4"),
    "edge.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n", "face 0 is a face with 2 corners"),
    "huge.off": (b"OFF\n1 1 0\n0 0 0\n3 0 1 99999999999999999999\n", "is no face"),
    "points.off": (b"OFF\n1 0 0\n0 0 0\n", "holds no triangles"),
    "quad.obj": (b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n", "line 5 is a polygon"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 0 1 2\n", "face 0 .* out of range"),
    "range.obj": (b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n", "face 0 .* out of range"),
    "huge.obj": (b"v 0 0 0\nf 1 2 99999999999999999999\n", "out of range"),
    "word.obj": (b"v 0 0 zero\nf 1 2 3\n", "is no vertex"),
    "slash.obj": (b"v 0 0 0\nf / 2 3\n", "line 2 is no face"),
    "points.obj": (b"v 0 0 0\n", "holds no triangles"),
    "junk.obj": ("Ünïcödé\n".encode() * 9, "holds no triangles"),
    "junk.stl": (bytes(range(256)), "neither ASCII STL"),
    "solid.stl": (b"solid x\n", "does not end"),
    "two.stl": (
        b"solid\nfacet\nvertex 0 0 0\nvertex 1 0 0\nendfacet\nendsolid\n",
        "face 0 is a face with 2 corners",
    ),
    "open.stl": (b"solid\nfacet\nvertex 0 0 0\nendsolid\n", "endfacet"),
    "none.stl": (b"solid\nendsolid\n", "holds no triangles"),
    "junk.ply": (b"\xff\xfe\x00ply", "no complete PLY header"),
    "head.ply": (b"ply\nformat ascii 1.0\nend_header\n", "names no vertices and faces"),
    "many.ply": (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\n"
        b"property float y\nproperty float z\nelement face 1\n"
        b"property list uchar int vertex_indices\nend_header\n\0\0",
        "shorter than its header",
    ),
    "kind.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nelement face 1\nend_header\n",
        "names no vertices",
    ),
    "order.ply": (
        b"ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int vertex_indices\n"
        b"element vertex 0\nproperty float x\nend_header\n",
        "unusual way",
    ),
    "wrong.ply": (PLY.replace("ascii", "utf").encode(), "unknown PLY format 'utf'"),
    "mesh.vtk": (b"vtk", r"unknown suffix '.vtk': use one of .obj, .off, .ply, .stl"),
    "mesh": (b"", "unknown suffix ''"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_named(tmp_path, name):
    content, message = BAD_FILES[name]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(jd.InputError, match=message) as error:
        jd.load_mesh(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("size", [2, 4])
def test_ply_faces_that_are_no_triangles(tmp_path, size):
    corners = f"{size} " + " ".join(map(str, range(size)))
    path = tmp_path / "m.ply"
    path.write_text(PLY.format(flags="comment", first="3 0 1 2", second=corners))
    message = "polygon with 4" if size == 4 else "2 corners"
    with pytest.raises(jd.InputError, match=f"face 1 is a .*{message}"):
        jd.load_mesh(path)


@pytest.mark.parametrize("at", [0, 700])
def test_binary_ply_polygon(tmp_path, bar, at):
    path = tmp_path / "m.ply"
    jd.save_mesh(path, bar)
    data = bytearray(path.read_bytes())
    data[len(data) - 13 * (1440 - at)] = 4
    path.write_bytes(data)
    with pytest.raises(jd.InputError, match=f"face {at} is a polygon with 4"):
        jd.load_mesh(path)


def test_missing_files_and_folders(tmp_path):
    (tmp_path / "folder.off").mkdir()
    for name in ("missing.off", "folder.off", "missing/x.ply"):
        with pytest.raises(jd.InputError, match="cannot be read"):
            jd.load_mesh(tmp_path / name)


def written(tmp_path, kind, odd) -> bytes:
    suffix = kind.removeprefix("ascii")
    path = tmp_path / f"whole{suffix}"
    if suffix != kind:
        ascii_ = igl.FileEncoding.Ascii
        igl.write_triangle_mesh(str(path), odd.vertices, np.asarray(odd.faces), ascii_)
    else:
        jd.save_mesh(path, odd, **({"rigidity": 1.0} if suffix == ".ply" else {}))
    return path.read_bytes()


@pytest.mark.parametrize("suffix", [*SUFFIXES, "ascii.ply", "ascii.stl"])
def test_a_truncated_file_is_refused_or_whole(tmp_path, odd, suffix):
    """At every byte, but within the last number of a text: "72" may be all of it or half of 721."""
    data = written(tmp_path, suffix, odd)
    path = tmp_path / f"cut{suffix.removeprefix('ascii')}"
    path.write_bytes(data)
    whole = jd.load_mesh(path)
    for size in range(len(data)):
        path.write_bytes(data[:size])
        try:
            mesh = jd.load_mesh(path)
        except jd.InputError as error:
            assert "\n" not in str(error)  # noqa: PT017 (either outcome is right)
            continue
        if not data[size:].strip().isdigit():
            assert mesh.vertices.tobytes() == whole.vertices.tobytes(), size
            np.testing.assert_array_equal(mesh.faces, whole.faces)


@pytest.mark.parametrize("suffix", [*SUFFIXES, "ascii.ply", "ascii.stl"])
def test_damaged_bytes_never_do_worse_than_an_input_error(tmp_path, odd, suffix):
    data = np.frombuffer(written(tmp_path, suffix, odd), np.uint8)
    path = tmp_path / f"hit{suffix.removeprefix('ascii')}"
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(300):
        hit = data.copy()
        hit[rng.integers(len(hit), size=3)] = rng.integers(256, size=3)
        path.write_bytes(hit.tobytes())
        try:
            jd.load_mesh(path)
        except jd.InputError:
            refused += 1
    assert refused > 0


# ---------------------------------------------------------------- writing


def test_a_failing_write_leaves_the_old_file(tmp_path, odd, monkeypatch):
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd)
    before = path.read_bytes()

    def half(error):
        def write(name):
            Path(name).write_bytes(before[:50])
            raise error

        return write

    with pytest.raises(jd.InputError, match="No space left on device"):
        write_beside(path, half(OSError(28, "No space left on device")))
    for error in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(error):
            write_beside(path, half(error()))
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(18, "no link")))
        with pytest.raises(jd.InputError, match="no link"):
            jd.save_mesh(path, odd, vertices=odd.vertices + 1)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["m.ply"]


def test_bad_arguments_leave_the_old_file(tmp_path, odd):
    path = tmp_path / "m.ply"
    jd.save_mesh(path, odd)
    before = path.read_bytes()
    nan = _set(odd.vertices, (3, 0), np.nan)
    for message, settings_ in {
        r"vertices have shape \(7, 3\)": {"vertices": odd.vertices[1:]},
        "vertex 3 is .*nan": {"vertices": nan},
        r"rigidity has shape \(2,\)": {"rigidity": [1.0, 2.0]},
    }.items():
        with pytest.raises(jd.InputError, match=message):
            jd.save_mesh(path, odd, **settings_)
    with pytest.raises(jd.InputError, match="only PLY carries rigidity"):
        jd.save_mesh(tmp_path / "m.off", odd, rigidity=1.0)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["m.ply"]


def test_places_that_cannot_be_written(tmp_path, odd):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "file").write_text("x")
    for name in ("missing/m.ply", "file/m.ply", "folder.ply", "m.xyz"):
        for door in (lambda path: jd.save_mesh(path, odd), jd.check_output):
            with pytest.raises(jd.InputError, match=name):
                door(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.ply"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission(tmp_path, odd):
    tmp_path.chmod(0o555)
    for door in (lambda path: jd.save_mesh(path, odd), jd.check_output):
        with pytest.raises(jd.InputError, match=r"m\.ply"):
            door(tmp_path / "m.ply")
    tmp_path.chmod(0o755)


def test_a_new_file_has_the_usual_permissions_and_an_old_one_keeps_its_own(tmp_path, odd):
    (tmp_path / "plain").touch()
    path = tmp_path / "m.off"
    jd.save_mesh(path, odd)
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    path.chmod(0o640)
    jd.save_mesh(path, odd)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


# ---------------------------------------------------------------- edges, mending


def test_edges_are_each_once_and_sorted(bar):
    pairs = {tuple(sorted((int(f[i]), int(f[i - 1])))) for f in bar.faces for i in range(3)}
    assert bar.edges.tolist() == sorted(map(list, pairs))


@st.composite
def soups(draw):
    """Vertices on a small grid (so that many coincide) and any faces among them."""
    n = draw(st.integers(3, 12))
    point = st.tuples(*[st.sampled_from([-0.0, 0.0, 1.0, 2.0])] * 3)
    v = draw(st.lists(point, min_size=n, max_size=n))
    face = st.tuples(*[st.integers(0, n - 1)] * 3)
    return np.array(v), np.array(draw(st.lists(face, min_size=1, max_size=15)))


def area(corners):
    return np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))


@settings(max_examples=150, deadline=None)
@given(soups())
def test_repair_is_what_brute_force_says(soup):
    v, f = soup
    want = {frozenset(map(tuple, v[face] + 0.0)) for face in f if area(v[face]) > 0}
    if not want:
        with pytest.raises(jd.InputError, match="no face with an area"):
            jd.repair(soup)
        return
    mesh, new = jd.repair(soup)
    found = [frozenset(map(tuple, mesh.vertices[face])) for face in mesh.faces]
    assert Counter(found) == Counter(want)
    # The first of equal faces stays, turned as it was.
    kept = {tuple(new[face]) for face in f if (new[face] >= 0).all()}
    assert {tuple(face) for face in mesh.faces} <= kept
    assert len({tuple(p) for p in mesh.vertices}) == mesh.n_vertices
    assert set(mesh.faces.ravel()) == set(range(mesh.n_vertices))
    used = set().union(*want)
    for old, index in enumerate(new):
        if tuple(v[old] + 0.0) in used:
            np.testing.assert_array_equal(mesh.vertices[index], v[old])
        else:
            assert index == -1
    again, same = jd.repair(mesh)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_array_equal(same, np.arange(mesh.n_vertices))


def test_repair_leaves_a_sound_mesh_and_reads_files(tmp_path, bar):
    jd.save_mesh(tmp_path / "bar.off", bar)
    for given_ in (bar, tmp_path / "bar.off", (bar.vertices, bar.faces)):
        mesh, new = jd.repair(given_)
        np.testing.assert_array_equal(mesh.vertices, bar.vertices)
        np.testing.assert_array_equal(mesh.faces, bar.faces)
        np.testing.assert_array_equal(new, np.arange(722))
    with pytest.raises(jd.InputError, match="out of range"):
        jd.repair((bar.vertices[:9], bar.faces))
    with pytest.raises(jd.InputError, match="give a Mesh, a pair"):
        jd.repair(7)


# ---------------------------------------------------------------- inspection


def defects():
    """Name of the finding -> (number in it, vertices, faces), on a tetrahedron or two."""
    v, f = tetrahedron()
    w = tetrahedron(5.0)[0]
    two = np.concatenate([v, w]), np.concatenate([f, f + 4])
    # The second tetrahedron's corner 0 moved onto the first one's corner 3, and joined with it.
    touching = np.concatenate([v, w[1:] - w[0] + v[3]])
    joined = np.array([3, 4, 5, 6])[f]
    # Three wings on one edge: the third page of a book.
    book = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.5], [-1, 1, 0.5], [-1, -1, 0.5]])
    return {
        "": (0, v, f),
        "faces repeat a vertex": (1, v, [*f, [0, 0, 1]]),
        "faces have no area": (1, [*v, [0.5, 0.5, 0]], [*f, [1, 2, 4]]),
        "vertices belong to no face": (2, [*v, [9, 9, 9], [8, 8, 8]], f),
        "faces are there twice": (1, v, [*f, [1, 0, 2]]),
        "further connected parts": (1, *two),
        "edges lie on the border": (3, v, f[1:]),
        "vertices lie exactly on another": (1, [*v, v[0]], _set(f, (0, 0), 4)),
        "edges have more than two faces": (1, book, [[0, 1, 2], [0, 1, 3], [0, 1, 4]]),
        "vertices join surfaces that meet nowhere else": (1, touching, [*f, *joined]),
        "edges have faces of opposite orientation": (3, v, _set(f, 0, f[0, ::-1])),
        "closed parts face inwards": (1, v, f[:, ::-1]),
        "edges have negative cotangent weights": (
            1,
            [[0, 0, 0], [2, 0, 0], [1, 0.5, 0], [1, -0.5, 0]],
            [[0, 1, 2], [1, 0, 3]],
        ),
        "angles are below 1 degree": (
            1,
            [[0, 0, 0], [100, 0, 0], [100, 1, 0]],
            [[0, 1, 2]],
        ),
    }


# What a defect brings along by its nature: an open mesh has a border, and so on.
BESIDES = {
    "faces have no area": {"vertices belong to no face"},
    "vertices lie exactly on another": {"edges lie on the border"},
    "edges have more than two faces": {"edges lie on the border"},
    "edges have negative cotangent weights": {"edges lie on the border"},
    "angles are below 1 degree": {"edges lie on the border"},
}


@pytest.mark.parametrize("name", defects())
def test_each_defect_is_found_and_no_other(name):
    count, v, f = defects()[name]
    found = {}
    for finding in jd.inspect((v, f)).findings:
        number, _, what = finding.partition(" ")
        found[next((d for d in defects() if d and what.startswith(d)), what)] = int(number)
    assert set(found) - BESIDES.get(name, set()) == ({name} if name else set())
    assert not name or found[name] == count


def test_an_unusable_mesh_is_reported_not_raised():
    v, f = tetrahedron()
    for vertices, faces in ((_set(v, 0, np.nan), f), (v, f + 1)):
        (finding,) = jd.inspect((vertices, faces)).findings
        assert finding.startswith("Unusable: ")


def fans(faces, vertex):
    """Walk from face to face over the edges at a vertex, and count the walks needed."""
    left = [set(map(int, face)) - {vertex} for face in faces if vertex in face]
    count = 0
    while left:
        count += 1
        reached = left.pop()
        while any(face & reached for face in left):
            for face in [face for face in left if face & reached]:
                left.remove(face)
                reached = reached | face
    return count


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10**6))
def test_non_manifold_vertices_by_brute_force(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 9))
    f = np.array([rng.choice(n, 3, replace=False) for _ in range(rng.integers(1, 9))])
    f = f[np.unique(np.sort(f, axis=1), axis=0, return_index=True)[1]]
    want = sum(fans(f, k) > 1 for k in range(n))
    found = [s for s in jd.inspect((rng.normal(size=(n, 3)), f)).findings if "meet nowhere" in s]
    assert found == [] if want == 0 else found[0].startswith(f"{want} vertices")


def test_measures(bar):
    counts = jd.inspect(bar).counts
    assert (counts["vertices"], counts["faces"], counts["edges"]) == (722, 1440, 2160)
    assert (counts["components"], counts["border edges"]) == (1, 0)
    assert counts["Euler characteristic"] == 2
    length = np.linalg.norm(np.diff(bar.vertices[bar.edges], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(counts["shortest edge"], length.min(), rtol=EXACT)
    np.testing.assert_allclose(counts["longest edge"], length.max(), rtol=EXACT)
    angles = igl.internal_angles(bar.vertices, bar.faces)
    np.testing.assert_allclose(counts["smallest angle"], np.degrees(angles.min()), rtol=1e-9)
    np.testing.assert_allclose(counts["largest angle"], np.degrees(angles.max()), rtol=1e-9)
    diagonal = np.sqrt(30**2 + 151**2 + 30**2)
    np.testing.assert_allclose(counts["bounding box diagonal"], diagonal, rtol=EXACT)


@pytest.mark.parametrize("name", ["fan3.obj", "hourglass_ico.obj", "octopus_10173.off"])
def test_real_meshes_are_reported(name):
    mesh = real_mesh(name)
    text = " ".join(jd.inspect(mesh).findings)
    expected = {
        "fan3.obj": "1 edges have more than two faces",
        "hourglass_ico.obj": "1 vertices join surfaces",
        "octopus_10173.off": "angles are below 1 degree",
    }
    assert expected[name] in text
    assert ("join surfaces" in text) == (name == "hourglass_ico.obj")
