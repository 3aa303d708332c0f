"""Images on meshes: which faces they are on, which way up, what is said where one is missing."""

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jaxdeform as jd
from jaxdeform._mesh.images import images_of
from jaxdeform._plotting.surface import Surface
from jaxdeform._plotting.texture import seen_at_vertices, textures_of

# By quarter: lower left, lower right, upper left, upper right.
QUARTERS = {"red": (200, 0, 0), "green": (0, 200, 0), "blue": (0, 0, 200), "yellow": (200, 200, 0)}
SQUARE = """
mtllib {library}
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
v 2 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl {material}
f 1/1 2/2 3/3 4/4
usemtl plain
f 2/1 5/2 6/3 3/4
"""


@pytest.fixture
def folder(tmp_path):
    """A square with an image beside one without, in a library with spaces and options."""
    image = np.zeros((32, 32, 3), np.uint8)
    for k, color in enumerate(QUARTERS.values()):
        row, column = 16 * (1 - k // 2), 16 * (k % 2)
        image[row : row + 16, column : column + 16] = color
    (tmp_path / "maps").mkdir()
    Image.fromarray(image).save(tmp_path / "maps" / "four quarters.png")
    (tmp_path / "my colours.mtl").write_text(
        "newmtl painted  wood\nKd 1 1 1\nmap_Kd -clamp on -s 1 1.0 1 maps\\four quarters.png\n"
        "newmtl plain\nKd 1 0 0\n"
    )
    text = SQUARE.format(library="my colours.mtl", material="painted  wood")
    (tmp_path / "square.obj").write_text(text)
    return tmp_path


def seen(mesh, path, **options) -> dict[str, np.ndarray]:
    """Return the mean pixel of each colour of the image, as (row, column)."""
    jd.render(path, mesh, [mesh.vertices], up="y", width=200, **options)
    pixels = np.asarray(Image.open(path), int)
    found = {}
    for name, color in QUARTERS.items():
        near = np.abs(pixels - np.array(color) * 0.88).max(axis=2) < 30  # light from the front
        if near.sum() > 50:
            found[name] = np.argwhere(near).mean(axis=0)
    return found


def test_an_image_lies_the_right_way_on_its_faces_alone(folder):
    at = seen(jd.load_mesh(folder / "square.obj"), folder / "out.png")
    assert at.keys() == QUARTERS.keys()
    assert at["red"][0] > at["blue"][0]  # rows count downwards
    assert at["green"][0] > at["yellow"][0]
    assert at["red"][1] < at["green"][1]
    assert at["blue"][1] < at["yellow"][1]
    assert max(column for _, column in at.values()) < 0.55 * 200  # not on the plain half


def test_values_are_over_the_image(folder):
    assert not seen(jd.load_mesh(folder / "square.obj"), folder / "out.png", values=[1.0])


def test_a_compressed_file_and_one_in_ply(folder):
    """MeshLab's way: one image in a comment, and coordinates of the corners of each face."""
    mesh = jd.load_mesh(folder / "square.obj")
    with gzip.open(folder / "packed.obj.gz", "wb") as file:
        file.write((folder / "square.obj").read_bytes())
    assert len(textures_of(jd.load_mesh(folder / "packed.obj.gz"))) == 1
    with pytest.warns(UserWarning, match="materials"):
        jd.save_mesh(folder / "square.ply", mesh)
    content = (folder / "square.ply").read_bytes()
    first, _, rest = content.partition(b"\n")
    named = b"comment TextureFile maps/four quarters.png\n"
    (folder / "named.ply").write_bytes(first + b"\n" + named + rest)
    (texture,) = textures_of(jd.load_mesh(folder / "named.ply"))
    assert texture.faces.all()
    (alone,) = textures_of(mesh)
    np.testing.assert_array_equal(alone.faces, [True, True, False, False])
    np.testing.assert_allclose(texture.places, alone.places)


def test_colours_at_vertices(folder):
    mesh = jd.load_mesh(folder / "square.obj")
    plain = np.full((6, 3), 0.5)
    colors = seen_at_vertices(mesh, Surface(mesh).textures, plain)
    want = [QUARTERS[name] for name in ("red", "green", "yellow", "blue")]
    np.testing.assert_allclose(colors[:4], np.array(want) / 255)
    np.testing.assert_array_equal(colors[4:], plain[4:])


@pytest.mark.parametrize("fault", ["missing", "no image", "too large", "cut off"])
def test_a_broken_image_is_named_and_left_out(folder, fault):
    place = folder / "maps" / "four quarters.png"
    if fault == "missing":
        place.unlink()
    elif fault == "no image":
        place.write_text("nothing")
    elif fault == "too large":
        data = place.read_bytes()
        header = b"IHDR" + struct.pack(">II", 100_000, 100_000) + data[24:29]
        place.write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])
    else:
        place.write_bytes(place.read_bytes()[:60])
    with pytest.warns(UserWarning, match=r"four quarters.png: .*: drawn without this image"):
        assert not seen(jd.load_mesh(folder / "square.obj"), folder / "out.png")


@pytest.mark.parametrize("name", ["nowhere.mtl", "", ".", "/", "\0", "x" * 300, "/proc/self/x"])
def test_names_that_lead_nowhere(folder, name):
    (folder / "odd.obj").write_text(SQUARE.format(library=name, material="painted  wood"))
    assert images_of(jd.load_mesh(folder / "odd.obj").source) == []


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="of Linux")
@pytest.mark.parametrize("place", ["/proc/self/mem", "/proc/kmsg"])
def test_files_that_the_system_makes_are_not_read(folder, place):
    (folder / "odd.obj").write_text(SQUARE.format(library=place, material="painted  wood"))
    with pytest.warns(UserWarning, match="drawn without its images"):
        assert images_of(jd.load_mesh(folder / "odd.obj").source) == []
    (folder / "my colours.mtl").write_text(f"newmtl painted  wood\nmap_Kd {place}\n")
    with pytest.warns(UserWarning, match="drawn without this image"):
        assert textures_of(jd.load_mesh(folder / "square.obj")) == []


@pytest.mark.parametrize(
    "line",
    [
        "map_Kd maps/four quarters.png # as painted",
        "map_kd\tmaps\\four quarters.png",
        "map_Kd -s 1.0e+00 1.0e-00 1 maps/four quarters.png",
        "map_Kd -mm 0 +1 -type sphere -colorspace sRGB -imfchan l maps/four quarters.png",
        "map_Kd C:\\somewhere\\else\\maps\\..\\four quarters.png",
        'map_Kd "maps/four quarters.png"',
    ],
)
def test_lines_that_programs_write(folder, line):
    image = folder / "maps" / "four quarters.png"
    (folder / "four quarters.png").write_bytes(image.read_bytes())
    text = f"map_Kd of nobody.png\nnewmtl\tpainted  wood\n{line}\n"
    (folder / "my colours.mtl").write_text(text, encoding="utf-8-sig")
    (texture,) = textures_of(jd.load_mesh(folder / "square.obj"))
    np.testing.assert_array_equal(texture.faces, [True, True, False, False])


def test_several_libraries_comments_and_one_image_of_two_materials(folder):
    """An image is read once, however many materials have it."""
    image = "map_Kd maps/four quarters.png\n"
    (folder / "a.mtl").write_text(f"newmtl painted\n{image}")
    (folder / "b.mtl").write_text(f"newmtl plain\n{image}")
    text = SQUARE.format(library="a.mtl b.mtl # both", material="painted # wood")
    (folder / "both.obj").write_text(text)
    (texture,) = textures_of(jd.load_mesh(folder / "both.obj"))
    assert texture.faces.all()


def test_a_palette_with_transparency_is_an_image(folder):
    place = folder / "maps" / "four quarters.png"
    with Image.open(place) as image:
        image.convert("RGBA").quantize(16).save(place)
    assert len(textures_of(jd.load_mesh(folder / "square.obj"))) == 1


def test_a_ply_with_other_line_ends_or_two_images(folder):
    mesh = jd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    lines = [
        *("ply", "format ascii 1.0", "comment TextureFile maps/four quarters.png"),
        *("element vertex 3", *(f"property float {x}" for x in "xyzst")),
        *("element face 1", "property list uchar int vertex_indices", "end_header"),
        *(f"{x} {y} {z} {x} {y}" for x, y, z in mesh.vertices),
        "3 0 1 2\r",
    ]
    (folder / "cr.ply").write_bytes("\r".join(lines).encode())
    assert len(textures_of(jd.load_mesh(folder / "cr.ply"))) == 1
    lines.insert(2, "comment TextureFile other.png")
    (folder / "two.ply").write_bytes("\n".join(lines).encode())
    with pytest.warns(UserWarning, match="names 2 images"):
        assert textures_of(jd.load_mesh(folder / "two.ply")) == []
