"""Images on meshes: which faces they are on, which way up, what is said where one is missing."""

import gzip
import struct
import zlib

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


def test_names_that_lead_nowhere(folder):
    """No library, an empty name, a folder, a library in a far place: no image, and no error."""
    for library in ("nowhere.mtl", "", ".", "/", "\0"):
        text = SQUARE.format(library=library, material="painted  wood")
        (folder / "odd.obj").write_text(text)
        assert images_of(jd.load_mesh(folder / "odd.obj").source) == []
