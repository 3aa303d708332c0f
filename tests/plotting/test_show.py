"""Meshes to be turned: what a page holds, and what an untrusted notebook makes of it."""

import base64
import re
import zlib
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from pixels import close_to, ink

import jaxdeform as jd
from jaxdeform._plotting.scene import FIXED, MOVED

msgpack = pytest.importorskip("msgpack")
pytest.importorskip("k3d")


def objects_of(page: str) -> list[dict]:
    """Return what is drawn, read without k3d."""
    (data,) = re.findall(r"data = '([^']*)'", page)
    return msgpack.unpackb(zlib.decompress(base64.b64decode(data)))["objects"]


def array_of(packed: dict) -> np.ndarray:
    return np.frombuffer(packed["data"], packed["dtype"]).reshape(packed["shape"])


def lengths(points, count=2000) -> np.ndarray:
    """Return distances between pairs of points, in units of the largest."""
    pairs = np.random.default_rng(0).integers(0, len(points), (count, 2))
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    return length / length.max()


def test_the_page_holds_every_pose_and_handle(bar, bent):
    low, high = (jd.select.where(bar, text) for text in ("v < 0.02", "v > 0.98"))
    shown = jd.show(bar, [bar.vertices, bent], handles=low | high, values=[0.1, 10.0])
    mesh, fixed, moved = objects_of(shown.html)
    faces = array_of(mesh["indices"])
    for k, pose in enumerate((bar.vertices, bent)):
        points = array_of(mesh["vertices"][str(k)])
        np.testing.assert_allclose(
            lengths(points[faces].reshape(-1, 3)),
            lengths(pose[bar.faces].reshape(-1, 3)),
            atol=1e-5,
        )
    soft, stiff = (array_of(mesh["colors"][k]) for k in "01")
    assert (soft == soft[0]).all()
    assert (stiff == stiff[0]).all()
    assert soft[0] != stiff[0]
    assert (fixed["color"], moved["color"]) == (int(FIXED[1:], 16), int(MOVED[1:], 16))
    assert len(array_of(fixed["positions"]["0"])) == low.mask.sum()
    assert len(array_of(moved["positions"]["0"])) == high.mask.sum()


def test_the_page_needs_nothing_from_elsewhere(bar):
    page = jd.show(bar).html
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?\s*(?:https?:)?//""", page)


def test_nothing_is_left_in_the_process(bar):
    """Widgets register themselves, with their arrays, until they are closed."""
    from ipywidgets.widgets.widget import _instances

    jd.show(bar, [bar.vertices], handles=[0])
    assert {type(widget).__name__ for widget in _instances.values()} <= {"Layout"}


class _Parts(HTMLParser):
    """The pictures and the frames of a piece of HTML."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: dict[str, list[dict]] = {"img": [], "iframe": []}
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        if tag in self.found:
            self.found[tag].append(dict(attrs))


def test_a_notebook_has_the_picture_under_the_page(bar, bent):
    shown = jd.show(bar, bent[None], handles=jd.select.where(bar, "v > 0.98"), width=200)
    (frame,), (picture,) = (_Parts(shown._repr_html_()).found[tag] for tag in ("iframe", "img"))
    assert frame["srcdoc"] == shown.html
    kind, data = picture["src"].split(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data) == shown.png == shown._repr_png_()
    image = np.asarray(Image.open(BytesIO(shown.png)), int)
    assert image.shape[1] == shown.width == 200
    assert image.shape[0] > shown.height  # the legend is below, and not covered
    assert ink(image[: shown.height]).mean() > 0.05
    assert len(close_to(image[: shown.height], MOVED)) > 10


def test_bad_input(bar, bent, tmp_path, monkeypatch):
    broken = bent.copy()
    broken[7] = np.nan
    with pytest.raises(jd.InputError, match=r"poses\[1\]: vertex 7 is not finite: leave this"):
        jd.show(bar, [bent, broken])
    shown = jd.show(bar, width=100)
    (tmp_path / "kept.html").write_text("mine")
    with pytest.raises(jd.InputError, match=r"pages are HTML files: use a .html name"):
        shown.save(tmp_path / "page.png")
    with pytest.raises(jd.InputError, match="folder"):
        shown.save(tmp_path / "nowhere" / "page.html")
    shown.save(tmp_path / "kept.html")
    assert (tmp_path / "kept.html").read_text() == shown.html
    monkeypatch.setattr("jaxdeform._plotting.show.find_spec", lambda name: None)
    with pytest.raises(jd.InputError, match=r"turning needs k3d: pip install"):
        jd.show(bar)
