"""Colours and texture coordinates go along into another format."""

import numpy as np
import pytest
from helpers import CASES

import jaxdeform as jd
from jaxdeform._mesh.extras import file_extras

OBJ = """v 0 0 0 1 0 0.2
v 1 0 0 0 1 0.4
v 1 1 0 0 0 0
v 0 1 0 0.2 0.4 0.6
v 2 0 1 1 1 1
vt 0 0
vt 1 0
vt 0.5 1 0
vt 0.25
f 1/1 2/2 3/3 4/-1
f 2/2 5/1 3/4
f 1 2 5
"""
TEXTURE = [[0, 0], [1, 0], [0.5, 1], [0.25, 0], [1, 0], [0, 0], [0.25, 0], *[[np.nan] * 2] * 3]
COLORS = [[1, 0, 0.2], [0, 1, 0.4], [0, 0, 0], [0.2, 0.4, 0.6], [1, 1, 1]]


@pytest.fixture
def mesh(tmp_path):
    (tmp_path / "m.obj").write_text(OBJ)
    return jd.load_mesh(tmp_path / "m.obj")


def through(mesh, path):
    """Return the mesh written to the path and read again."""
    jd.save_mesh(path, mesh, vertices=mesh.vertices + 1)
    return jd.load_mesh(path)


def test_what_an_obj_says(mesh):
    np.testing.assert_array_equal(file_extras(mesh.source).colors, COLORS)
    np.testing.assert_array_equal(file_extras(mesh.source).texture, TEXTURE)


def test_an_obj_into_a_ply_and_back(mesh, tmp_path):
    """The colours are multiples of 1/255, and the coordinates are float32."""
    once = through(mesh, tmp_path / "m.ply")
    twice = through(once, tmp_path / "back.obj")
    for other, moved in ((once, 1), (twice, 2)):
        assert other.source is not None
        np.testing.assert_array_equal(other.vertices, mesh.vertices + moved)
        assert other.source.polygons.sizes.tolist() == [4, 3, 3]
        np.testing.assert_allclose(file_extras(other.source).colors, COLORS, atol=1e-15)
        np.testing.assert_array_equal(file_extras(other.source).texture, TEXTURE)
    lines = (tmp_path / "back.obj").read_text().splitlines()
    assert sum(line.startswith("vt ") for line in lines) == 4  # each pair once
    assert lines[-1] == "f 1 2 5"


def test_pyvista_reads_them_from_the_ply(tmp_path):
    """It makes two points of a vertex with two pairs of coordinates."""
    pyvista = pytest.importorskip("pyvista")
    (tmp_path / "m.obj").write_text(OBJ.replace("f 1 2 5\n", ""))
    mesh = jd.load_mesh(tmp_path / "m.obj")
    jd.save_mesh(tmp_path / "m.ply", mesh)
    there = pyvista.read(tmp_path / "m.ply")
    corners = np.concatenate([face.point_ids for face in there.cell])
    assert mesh.source is not None
    vertex = mesh.source.polygons.corners
    np.testing.assert_array_equal(there.points[corners], mesh.vertices[vertex])
    np.testing.assert_array_equal(there.point_data["RGB"][corners] / 255, np.array(COLORS)[vertex])
    np.testing.assert_array_equal(there.active_texture_coordinates[corners], TEXTURE[:7])


def test_rigidity_beside_them(mesh, tmp_path):
    jd.save_mesh(tmp_path / "m.ply", mesh, rigidity=[1, 2, 3, 4, 5.5])
    assert jd.load_rigidity(tmp_path / "m.ply").tolist() == [1, 2, 3, 4, 5.5]
    again = jd.load_mesh(tmp_path / "m.ply")
    np.testing.assert_array_equal(file_extras(again.source).texture, TEXTURE)


def test_an_off_holds_colours(mesh, tmp_path):
    with pytest.warns(UserWarning, match=r"m.off: OFF cannot hold the texture coordinates of"):
        there = through(mesh, tmp_path / "m.off")
    assert (tmp_path / "m.off").read_text().splitlines()[2].split()[3:] == ["255", "0", "51", "255"]
    np.testing.assert_allclose(file_extras(there.source).colors, COLORS, atol=1e-15)
    back = through(there, tmp_path / "back.ply")
    np.testing.assert_allclose(file_extras(back.source).colors, COLORS, atol=1e-15)


def test_an_stl_holds_nothing(mesh, tmp_path):
    with pytest.warns(UserWarning, match="STL cannot hold the colours and texture coordinates of"):
        through(mesh, tmp_path / "m.stl")


def test_colours_that_are_nearly_black(tmp_path):
    """A byte of 1 is no full colour."""
    path = tmp_path / "m.off"
    path.write_text("COFF\n3 1 0\n0 0 0 1 0 0 255\n1 0 0 0 1 0 255\n0 1 0 0 0 0 255\n3 0 1 2\n")
    want = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0]]) / 255
    there = jd.load_mesh(path)
    np.testing.assert_array_equal(file_extras(there.source).colors, want)
    np.testing.assert_array_equal(
        file_extras(through(there, tmp_path / "m.ply").source).colors, want
    )


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_coordinates_at_the_vertices_of_a_ply(tmp_path, names):
    path = tmp_path / "m.ply"
    fields = "".join(f"property float {name}\n" for name in ("x", *names, "y", "z"))
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 3\n{fields}element face 1\n"
        "property list uchar int vertex_index\nend_header\n"
        "0 0.5 1 0 0\n1 0.25 0 0 0\n0 0 0 1 0\n3 2 0 1\n"
    )
    there = through(jd.load_mesh(path), tmp_path / "m.obj")
    want = [[0, 0], [0.5, 1], [0.25, 0]]
    np.testing.assert_array_equal(file_extras(there.source).texture, want)


@pytest.mark.parametrize("last", ["6 0 0 1 0 0.5 1", "0"])
def test_coordinates_at_the_corners_of_a_text_ply(tmp_path, last):
    path = tmp_path / "m.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_index\n"
        "property list uchar float texcoord\nend_header\n"
        f"0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 1 1 0 1 0 0\n3 0 1 2 {last}\n"
    )
    there = through(jd.load_mesh(path), tmp_path / "m.obj")
    rest = [[0, 0], [1, 0], [0.5, 1]] if last != "0" else [[np.nan] * 2] * 3
    want = [[1, 1], [0, 1], [0, 0], *rest]
    np.testing.assert_array_equal(file_extras(there.source).texture, want)


@pytest.mark.parametrize("name", ["02_quads.obj", "24_quad.off", "46_upper_crlf.stl"])
def test_a_file_without_them_gives_none(tmp_path, name):
    there = jd.load_mesh(CASES / name)
    assert file_extras(there.source) == (None, None)
    assert file_extras(through(there, tmp_path / "m.ply").source) == (None, None)


# ---------------------------------------------------------------- what only one format holds

PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float quality
element face 1
property list uchar int vertex_indices
property uchar red
end_header
0 0 0 1
1 0 0 2
0 1 0 3
3 0 1 2 9
"""
ONE_FORMAT = {
    "m.obj": (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\ng a\nusemtl b\nf 1 2 3\ng c\nf 3 2 1\n",
        "groups and materials",
    ),
    "some.obj": ("v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "colours of some vertices"),
    "lines.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nl 1 2\np 3\n", "lines and points"),
    "m.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n", "colours of faces"),
    "m.ply": (PLY, "vertex quality and face red"),
}


@pytest.mark.parametrize("name", ONE_FORMAT)
def test_what_only_its_own_format_holds_is_said(name, tmp_path, recwarn):
    text, lost = ONE_FORMAT[name]
    (tmp_path / name).write_text(text)
    mesh = jd.load_mesh(tmp_path / name)
    jd.save_mesh(tmp_path / f"moved_{name}", mesh, vertices=mesh.vertices + 1)
    assert not recwarn.list
    other = "o.ply" if name.endswith(".obj") else "o.obj"
    with pytest.warns(UserWarning, match=f"cannot hold the {lost} of the file"):
        jd.save_mesh(tmp_path / other, mesh)


def test_colours_of_an_obj_with_any_keyword_and_over_lines(tmp_path):
    text = OBJ.replace("v 1 1 0 0 0 0", "V 1 1 0 \\\n0 0 0", 1)
    (tmp_path / "m.obj").write_text(text)
    np.testing.assert_array_equal(
        file_extras(jd.load_mesh(tmp_path / "m.obj").source).colors, COLORS
    )
