"""Pictures of meshes: what is drawn where, in which colours, and what is said about it."""

import numpy as np
import pytest
from PIL import Image
from pixels import WIDTH, close_to, ink, panels

import jaxdeform as jd
from jaxdeform._mesh.extras import file_colors
from jaxdeform._plotting.arguments import find_faults
from jaxdeform._plotting.color import RAMP
from jaxdeform._plotting.scene import FIXED, MOVED


@pytest.mark.parametrize("broken", ["exploded", "nan", "all nan", "far away"])
def test_a_broken_pose_changes_no_other(drawn, bar, bent, exploded, broken):
    nan = np.where(np.arange(722)[:, None] % 5 == 0, np.nan, bent)
    pose = {
        "exploded": exploded,
        "nan": nan,
        "all nan": np.full_like(bent, np.nan),
        "far away": bent + 1e9,
    }[broken]
    alone = drawn([bar.vertices, bent], values="stretch")
    beside = drawn([bar.vertices, pose, bent], values="stretch")
    first, middle, last = panels(beside, 3)
    # The title of the broken one moves the others down.
    down = beside.shape[0] - alone.shape[0]
    assert down > 0
    foot = 60
    for image, want in zip((first, last), panels(alone, 2), strict=True):
        np.testing.assert_array_equal(image[down:-foot], want[:-foot])
        assert not ink(image[:down]).any()
    red = (middle[:down, :, 0] - middle[:down, :, 1] > 60).sum()
    assert red > 20


def test_what_is_said_about_a_broken_pose(bar, bent, exploded):
    nan = bent.copy()
    nan[:3] = np.nan
    told = [fault.words for fault in find_faults(bar, [bent, exploded, nan, 1e3 * bent])]
    assert told[0] == ""
    assert "times as far: cut off" in told[1]
    assert told[2] == "3 of 722 vertices not finite"
    assert "times as far: cut off" in told[3]
    # A whole path in another unit hides nobody.
    assert not any(fault.words for fault in find_faults(bar, [1e3 * bent] * 3))


def test_a_given_axis_is_up(drawn, bar):
    """The bar lies across the picture if z is up."""
    upright, lying = (drawn([bar.vertices], up=up) for up in ("y", "z"))
    for image, high in ((upright, True), (lying, False)):
        rows, columns = ink(image).nonzero()
        assert (np.ptp(rows) > np.ptp(columns)) == high


def test_handles_are_marked(drawn, bar, bent):
    low = np.flatnonzero(bar.vertices[:, 1] < 1)
    high = np.flatnonzero(bar.vertices[:, 1] > 145)
    chosen = np.concatenate([low, high])
    bare = drawn([bar.vertices])
    assert not len(close_to(bare, FIXED))
    assert not len(close_to(bare, MOVED, 60))
    marked = drawn([bar.vertices], handles=chosen, moved=high)
    above = marked[: bare.shape[0]]
    assert close_to(above, FIXED).max() > close_to(above, MOVED, 60).min()
    assert np.median(close_to(above, FIXED)) > np.median(close_to(above, MOVED, 60))
    # By default those that a pose moves: of rest alone, none.
    none = drawn([bar.vertices], handles=chosen)
    assert not len(close_to(none, MOVED, 60))
    assert len(close_to(drawn([bar.vertices, bent], handles=chosen), MOVED, 60))


def test_the_colour_bar_has_all_colours_and_its_title_aside(drawn, bar):
    values = np.where(bar.vertices[:, 1] < 75, 0.01, 30.0)
    image = drawn([bar.vertices] * 2, values=[values, values])
    plain = drawn([bar.vertices] * 2)
    foot = image[plain.shape[0] :]
    ramp = np.rint(255 * RAMP)
    # The row through the middle of the bar: from the softest to the stiffest colour.
    row = foot[18]
    near = [int(np.abs(row - color).max(axis=1).min()) for color in ramp[::16]]
    assert max(near) < 12
    columns = [int(np.abs(row - color).max(axis=1).argmin()) for color in ramp[::16]]
    assert columns == sorted(columns)
    # No letter in the columns of the bar above the bar itself.
    assert not ink(foot[:10]).any()
    # The two halves of the mesh have the two ends of the scale.
    body = image[: plain.shape[0]]
    assert (body[..., 0] > body[..., 2] + 40).sum() > 200
    assert (body[..., 2] > body[..., 0] + 40).sum() > 200


@pytest.mark.parametrize("kind", ["ply", "obj", "off"])
def test_the_colours_of_the_file(kind, tmp_path):
    given = {
        "ply": "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 51\n3 0 1 2\n",
        "obj": "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 0.2\nf 1 2 3\n",
        "off": "COFF\n3 1 0\n0 0 0 255 0 0 255\n1 0 0 0 255 0 255\n0 1 0 0 0 51 255\n3 0 1 2\n",
    }
    path = tmp_path / f"mesh.{kind}"
    path.write_text(given[kind])
    mesh = jd.load_mesh(path)
    np.testing.assert_allclose(file_colors(mesh.source), [[1, 0, 0], [0, 1, 0], [0, 0, 0.2]])
    jd.render(tmp_path / "out.png", mesh, [mesh.vertices], width=40)
    image = np.asarray(Image.open(tmp_path / "out.png"), int)
    assert (image[..., 0] > image[..., 1] + 90).any()
    assert (image[..., 1] > image[..., 0] + 90).any()


def test_without_colours_in_the_file(tmp_path, bar):
    for name in ("bar.obj", "bar.off", "bar.ply", "bar.stl"):
        jd.save_mesh(tmp_path / name, bar)
        assert file_colors(jd.load_mesh(tmp_path / name).source) is None
    assert file_colors(bar.source) is None


def test_panels_wrap_into_rows(drawn, bar):
    shapes = {n: drawn([bar.vertices] * 7, columns=n).shape[:2] for n in (1, 3, 7)}
    (panel, _) = shapes[7]
    assert shapes == {1: (7 * panel, WIDTH), 3: (3 * panel, 3 * WIDTH), 7: (panel, 7 * WIDTH)}
    assert drawn([bar.vertices] * 7).shape[:2] == (2 * panel, 4 * WIDTH)


def test_a_grid_has_the_panels_of_single_pictures(drawn, bar, bent, tmp_path):
    table = [[bar.vertices, bent], [bent, bar.vertices]]
    jd.render_grid(
        tmp_path / "grid.png", bar, table, ["r = 1", "r = 2"], ["λ = 0.1", "λ = 1"], width=WIDTH
    )
    grid = np.asarray(Image.open(tmp_path / "grid.png"), int)
    one, two = panels(drawn([bar.vertices, bent]), 2)
    tall = one.shape[0]
    left, top = grid.shape[1] - 2 * WIDTH, grid.shape[0] - 2 * tall
    assert left > 0
    assert top > 0
    rows = np.split(grid[top:, left:], 2)
    for row, pair in zip(rows, ((one, two), (two, one)), strict=True):
        for image, want in zip(panels(row, 2), pair, strict=True):
            np.testing.assert_array_equal(image, want)
    # The labels are beside and above the panels, not in them.
    assert ink(grid[top:, :left]).any()
    assert ink(grid[:top, left:]).any()


def test_edges_are_drawn_only_if_asked_for(drawn, bar):
    plain, lines = (len(np.unique(drawn([bar.vertices], edges=e), axis=0)) for e in (False, True))
    assert lines > plain


def test_pictures_of_a_bad_name(bar, tmp_path):
    with pytest.raises(jd.InputError, match=r"use a \.png name"):
        jd.render(tmp_path / "bar.jpg", bar, [bar.vertices])


def test_misuse_is_named(bar, tmp_path):
    path = tmp_path / "out.png"
    pose = bar.vertices
    told = {
        r"poses\[0\] has shape \(721, 3\), expected \(722, 3\)": lambda: jd.render(
            path, bar, [pose[1:]]
        ),
        "values is the text 'strain': give 'stretch' or numbers": lambda: jd.render(
            path, bar, [pose], values="strain"
        ),
        "moved: vertex 7 is no handle": lambda: jd.render(
            path, bar, [pose], handles=[1], moved=[7]
        ),
        "moved says which handles move, but handles is None": lambda: jd.render(
            path, bar, [pose], moved=[7]
        ),
        r"poses\[1\] has 1 entries, but columns has 2 texts": lambda: jd.render_grid(
            path, bar, [[pose, pose], [pose]], ["a", "b"], ["c", "d"]
        ),
        r"values has 1 rows, but rows has 2 texts": lambda: jd.render_grid(
            path, bar, [[pose], [pose]], ["a", "b"], ["c"], values=[[1.0]]
        ),
        "columns is empty": lambda: jd.render_grid(path, bar, [[]], ["a"], []),
    }
    for message, call in told.items():
        with pytest.raises(jd.InputError, match=message):
            call()
    assert not path.exists()


@pytest.mark.parametrize("suffix", [".png", ".gif"])
def test_a_picture_is_written_whole_or_not_at_all(bar, tmp_path, monkeypatch, suffix):
    path = tmp_path / f"out{suffix}"
    path.write_bytes(b"the picture of yesterday")
    draw = jd.render if suffix == ".png" else jd.animate

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        with pytest.raises(jd.InputError, match="No space left on device"):
            draw(path, bar, [bar.vertices], width=40)
    assert path.read_bytes() == b"the picture of yesterday"
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    draw(path, bar, [bar.vertices], width=40)
    assert path.read_bytes()[:4] in (b"\x89PNG", b"GIF8")


@pytest.mark.parametrize("size", [1e-30, 1e-3, 1e12])
def test_the_unit_of_a_mesh_changes_no_pixel(bar, tmp_path, drawn, bent, size):
    """Also far from the origin, where single precision knows no millimetres."""
    mesh = jd.Mesh((bar.vertices + 1e4) * size, bar.faces)
    jd.render(tmp_path / "out.png", mesh, [mesh.vertices, (bent + 1e4) * size], width=WIDTH)
    image = np.asarray(Image.open(tmp_path / "out.png"), int)
    want = drawn([bar.vertices, bent])
    assert (np.abs(image - want).max(axis=2) > 8).mean() < 2e-3
