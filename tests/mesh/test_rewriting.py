"""A file that was read is written with other positions, and all else that it held."""

import pickle

import igl
import numpy as np
import pytest
from helpers import CASES, EXACT, crosses, moved

import jaxdeform as jd

NAMES = sorted(path.name for path in CASES.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_without_a_change_it_is_the_same_file(tmp_path, name):
    jd.save_mesh(tmp_path / name, jd.load_mesh(CASES / name))
    assert (tmp_path / name).read_bytes() == (CASES / name).read_bytes()


@pytest.mark.parametrize("name", NAMES)
def test_new_positions_come_back_and_the_rest_stays(tmp_path, name):
    mesh = jd.load_mesh(CASES / name)
    jd.save_mesh(tmp_path / name, mesh, vertices=moved(mesh))
    back = jd.load_mesh(tmp_path / name)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    if name.startswith("47"):  # single precision
        np.testing.assert_array_equal(back.vertices, moved(mesh).astype(np.float32))
    else:
        assert back.vertices.tobytes() == moved(mesh).tobytes()
    assert back.source.polygons.same(mesh.source.polygons)
    assert back.source.trailing == mesh.source.trailing


@pytest.mark.parametrize("name", NAMES)
def test_a_source_goes_with_other_positions_but_not_with_other_faces(tmp_path, name):
    mesh = jd.load_mesh(CASES / name)
    pose = jd.Mesh(moved(mesh), mesh.faces, source=mesh.source)
    jd.save_mesh(tmp_path / name, mesh, vertices=moved(mesh))
    want = (tmp_path / name).read_bytes()
    jd.save_mesh(tmp_path / name, pose)
    assert (tmp_path / name).read_bytes() == want
    one_more = np.append(mesh.vertices, [[0.0, 0.0, 1.0]], axis=0)
    others = [
        (one_more, mesh.faces),
        (mesh.vertices, np.append(mesh.faces, mesh.faces[:1], axis=0)),
    ]
    if len(mesh.source.polygons.sizes) > 1:
        others.append((mesh.vertices, np.roll(mesh.faces, 1, axis=0)))
    for vertices, faces in others:
        with pytest.raises(jd.InputError, match="source is of a mesh with other faces"):
            jd.Mesh(vertices, faces, source=mesh.source)


@pytest.mark.parametrize("name", ["02_quads.obj", "24_quad.off", "07_colors_w.obj"])
def test_libigl_reads_what_we_rewrite(tmp_path, name):
    mesh = jd.load_mesh(CASES / name)
    jd.save_mesh(tmp_path / name, mesh, vertices=moved(mesh))
    v, _ = igl.read_triangle_mesh(str(tmp_path / name))
    np.testing.assert_allclose(v, moved(mesh), rtol=EXACT)


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".ply.gz"])
@pytest.mark.parametrize("name", ["02_quads.obj", "24_quad.off"])
def test_another_format_keeps_the_polygons(tmp_path, name, suffix):
    mesh = jd.load_mesh(CASES / name)
    path = tmp_path / f"m{suffix}"
    jd.save_mesh(path, mesh, vertices=moved(mesh))
    back = jd.load_mesh(path)
    assert back.vertices.tobytes() == moved(mesh).tobytes()
    assert back.source.polygons.sizes.tolist() == [4] * (mesh.n_faces // 2)
    assert back.source.polygons.same(mesh.source.polygons)


def test_stl_gets_the_triangles_of_the_mesh(tmp_path):
    """As they were cut at rest, whatever the pose."""
    mesh = jd.load_mesh(CASES / "02_quads.obj")
    jd.save_mesh(tmp_path / "m.stl", mesh, vertices=moved(mesh))
    back = jd.load_mesh(tmp_path / "m.stl")
    want = moved(mesh)[mesh.faces].astype(np.float32)
    np.testing.assert_array_equal(back.vertices[back.faces], want)


def test_a_polygon_of_many_corners_goes_through_ply(tmp_path):
    """Its length needs more than a byte."""
    angle = np.arange(300) * 2 * np.pi / 300
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lines = [f"v {x!r} {y!r} 0" for x, y in circle.tolist()]
    (tmp_path / "m.obj").write_text("\n".join([*lines, "f " + " ".join(map(str, range(1, 301)))]))
    mesh = jd.load_mesh(tmp_path / "m.obj")
    jd.save_mesh(tmp_path / "m.ply", mesh)
    assert jd.load_mesh(tmp_path / "m.ply").source.polygons.same(mesh.source.polygons)
    assert mesh.n_faces == 298


def test_the_source_changes_no_equality_and_goes_through_pickle(tmp_path):
    mesh = jd.load_mesh(CASES / "02_quads.obj")
    plain = jd.Mesh(mesh.vertices, mesh.faces)
    assert plain == mesh
    assert hash(plain) == hash(mesh)
    assert plain.digest == mesh.digest
    back = pickle.loads(pickle.dumps(mesh))
    assert back == mesh
    assert back.source.data == mesh.source.data
    for one in (mesh, back):
        arrays = one.vertices, one.faces, one.source.points, *one.source.polygons
        assert not any(array.flags.writeable for array in arrays)
    jd.save_mesh(tmp_path / "m.obj", back)
    assert (tmp_path / "m.obj").read_bytes() == (CASES / "02_quads.obj").read_bytes()
    jd.save_mesh(tmp_path / "m.obj", plain)
    assert jd.load_mesh(tmp_path / "m.obj").source.polygons.sizes.tolist() == [3] * 4


OBJ = """# by hand \\
mtllib wood and steel.mtl
o table
V 0 0 0 0.5 0.25 1 # colour
v\t1   0 0
vt 0 0
vt 1 0.5
v 1 1 \\
  0 1.0
vn 0 0 1
v 0 1 0
g top front
usemtl wood
s off
f 1/1/1 2/2/1 3/2/1 4/1/1
v 2 0 0
v 2 1 0
vn 0 0 1
vn 5 5 5
l 1 2 3
F 2/2/-2 5/1/-2 \\
 6/2/-2 -4/1/-2
p 1
"""


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_obj_keeps_every_line_but_positions_and_normals(tmp_path, end):
    path = tmp_path / "m.obj"
    text = OBJ.replace("\n", end)
    path.write_bytes(text.encode())
    mesh = jd.load_mesh(path)
    assert mesh.vertices[2].tolist() == [1, 1, 0]
    new = mesh.vertices + np.array([0.1, 0.2, 1 / 3])
    jd.save_mesh(path, mesh, vertices=new)
    old_lines, new_lines = text.split(end), path.read_bytes().decode().split(end)
    assert len(old_lines) == len(new_lines)
    changed = [k for k, (a, b) in enumerate(zip(old_lines, new_lines, strict=True)) if a != b]
    # A move as a whole changes no normal but its digits.
    assert {old_lines[k].split()[0].lower() for k in changed} == {"v", "vn", "0"}
    assert new_lines[3] == f"V 0.1 0.2 {1 / 3!r} 0.5 0.25 1 # colour"
    assert new_lines[4].startswith("v\t1.1   0.2 0.333")
    assert new_lines[8].endswith(" 1.0")
    assert new_lines[9] == "vn 0.000000 0.000000 1.000000"
    assert new_lines[18] == "vn 5 5 5"  # used by no face


def test_a_normal_that_served_many_vertices_is_divided(tmp_path):
    """Both faces name equal normals at the edge between them: it was smooth, and stays so."""
    path = tmp_path / "m.obj"
    path.write_text(OBJ)
    mesh = jd.load_mesh(path)
    new = moved(mesh)
    jd.save_mesh(path, mesh, vertices=new)
    lines = [
        line.split("#")[0].split() for line in path.read_text().replace("\\\n", "").split("\n")
    ]
    normals = np.array([line[1:] for line in lines if line[:1] == ["vn"]], float)
    corners = [line[1:] for line in lines if line[:1] in (["f"], ["F"])]
    assert [word.split("/")[1] for word in corners[0] + corners[1]] == list("12212121"[:8])
    faces = [[0, 1, 2, 3], [1, 4, 5, 2]]
    one, two = crosses(new, *faces)
    want = {0: one, 3: one, 1: one + two, 2: one + two, 4: two, 5: two}
    for face, words in zip(faces, corners, strict=True):
        for vertex, word in zip(face, words, strict=True):
            found = normals[int(word.split("/")[2]) - 1]
            expected = want[vertex] / np.linalg.norm(want[vertex])
            np.testing.assert_allclose(found, expected, atol=1e-6)
    # It is a fixed point: the same normals come out again.
    again = jd.load_mesh(path)
    jd.save_mesh(tmp_path / "again.obj", again, vertices=again.vertices + 3)
    back = [line for line in (tmp_path / "again.obj").read_text().split("\n") if line[:2] == "vn"]
    assert len(back) == len(normals)


def test_a_sharp_edge_stays_sharp(tmp_path):
    """Two faces at an edge that named different normals there."""
    path = tmp_path / "m.obj"
    lines = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "v 1 0 -1", "v 1 1 -1"]
    path.write_text("\n".join([*lines, "vn 0 0 1", "vn 1 0 0", "f 1//1 2//1 3//1 4//1",
                               "f 2//2 5//2 6//2 3//2"]))  # fmt: skip
    mesh = jd.load_mesh(path)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    jd.save_mesh(path, mesh, vertices=mesh.vertices @ turn.T)
    found = [line.split() for line in path.read_text().split("\n")]
    normals = np.array([line[1:] for line in found if line[0] == "vn"], float)
    np.testing.assert_allclose(normals, turn[:, [2, 0]].T, atol=1e-6)
    assert next(line for line in found if line[0] == "f") == ["f", "1//1", "2//1", "3//1", "4//1"]


def test_an_off_keeps_colours_and_comments(tmp_path):
    path = tmp_path / "m.off"
    text = """CNOFF # by hand
# counts
4 2 0

0 0 0  0 0 1  9 9 9 255 # first
1 0 0  0 0 1  9 9 9 255
1 1 0  0 0 1  9 9 9 255
0 1 0  0 0 1  9 9 9 255
3 0 1 2  255 0 0
3 0 2 3  0 255 0
# the end
"""
    path.write_text(text)
    mesh = jd.load_mesh(path)
    new = moved(mesh)
    jd.save_mesh(path, mesh, vertices=new)
    old_lines, new_lines = text.split("\n"), path.read_text().split("\n")
    assert old_lines[:4] + old_lines[8:] == new_lines[:4] + new_lines[8:]
    one, two = crosses(new, [0, 1, 2], [0, 2, 3])
    for k, total in enumerate([one + two, one, one + two, two]):
        words = new_lines[4 + k].split()
        assert list(map(float, words[:3])) == new[k].tolist()
        np.testing.assert_allclose(
            np.array(words[3:6], float), total / np.linalg.norm(total), atol=1e-6
        )
        assert words[6:] == old_lines[4 + k].split()[6:]


def test_a_text_stl_stays_a_text(tmp_path):
    path = tmp_path / "m.stl"
    text = (CASES / "46_upper_crlf.stl").read_text()
    mesh = jd.load_mesh(CASES / "46_upper_crlf.stl")
    jd.save_mesh(path, mesh, vertices=moved(mesh))
    old_lines = (CASES / "46_upper_crlf.stl").read_bytes().split(b"\r\n")
    new_lines = path.read_bytes().split(b"\r\n")
    assert len(old_lines) == len(new_lines)
    for old, new in zip(old_lines, new_lines, strict=True):
        assert old == new or old.split()[0] in (b"VERTEX", b"FACET")
    found = [list(map(float, line.split()[2:])) for line in new_lines if b"NORMAL" in line]
    want = np.array(crosses(moved(mesh), *mesh.faces))
    want /= np.linalg.norm(want, axis=1)[:, None]
    np.testing.assert_allclose(found, want, atol=1e-6)
    assert text.startswith("SOLID A B C")


def test_a_binary_stl_keeps_its_head_its_attributes_and_what_follows(tmp_path):
    old = bytearray((CASES / "47_binary_trailing_bytes.stl").read_bytes())
    old[:5] = b"COLOR"
    for k in range(8):
        old[84 + 50 * k + 48] = k  # the attribute of each face
    (tmp_path / "m.stl").write_bytes(old)
    mesh = jd.load_mesh(tmp_path / "m.stl")
    jd.save_mesh(tmp_path / "m.stl", mesh, vertices=moved(mesh))
    new = (tmp_path / "m.stl").read_bytes()
    assert len(new) == len(old)
    assert new[:84] == old[:84]
    assert new[-3:] == old[-3:]
    assert [new[84 + 50 * k + 48] for k in range(8)] == list(range(8))


def test_a_byte_order_mark_stays(tmp_path):
    path = tmp_path / "m.off"
    path.write_bytes(b"\xef\xbb\xbf" + (CASES / "24_quad.off").read_bytes())
    mesh = jd.load_mesh(path)
    jd.save_mesh(path, mesh, vertices=mesh.vertices + 1)
    assert path.read_bytes().startswith(b"\xef\xbb\xbfOFF\n4 1 0\n1.0 1.0 1.0\n")


def test_inspect_tells_of_polygons_and_of_bytes_behind_the_end(tmp_path):
    findings = jd.inspect(CASES / "02_quads.obj").findings
    assert findings[0].startswith("2 faces have more than three corners: cut into triangles")
    assert jd.inspect(jd.load_mesh(CASES / "02_quads.obj")).findings == findings
    findings = jd.inspect(CASES / "47_binary_trailing_bytes.stl").findings
    assert findings == ("3 bytes follow the end of the mesh: not read",)
    for name in ("24_quad.off", "37_tristrips.ply"):
        (tmp_path / name).write_bytes((CASES / name).read_bytes() + b"more \n\n")
        assert "5 bytes follow the end" in " ".join(jd.inspect(tmp_path / name).findings)


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("47")])
def test_what_is_read_can_be_written_whatever_the_damage(tmp_path, name):
    """Bytes changed, put in and left out. (Single precision of 47 would join close points.)"""
    data = np.frombuffer((CASES / name).read_bytes(), np.uint8)
    rng = np.random.default_rng(len(name))
    signs = np.frombuffer(b"0123456789 -.\n\r#\\_efvnEFV/\0\t", np.uint8)
    read = refused = 0
    for _ in range(150):
        at = int(rng.integers(len(data)))
        cut = int(rng.integers(3))
        hit = [data[:at], rng.choice(signs, rng.integers(3)), data[at + cut :]]
        path = tmp_path / name
        path.write_bytes(np.concatenate(hit).tobytes())
        try:
            mesh = jd.load_mesh(path)
        except jd.InputError:
            refused += 1
            continue
        read += 1
        try:
            jd.save_mesh(path, mesh, vertices=mesh.vertices * 2)
        except jd.InputError as error:
            assert "not finite" in str(error) or "inf" in str(error)  # noqa: PT017
            continue
        back = jd.load_mesh(path)
        assert back.vertices.tobytes() == (mesh.vertices * 2).tobytes()
        assert back.source.polygons.same(mesh.source.polygons)
    assert read > 0
    assert refused > 0
