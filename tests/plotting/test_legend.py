"""The legend below a picture."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import ImageDraw

from jaxdeform._plotting.color import scale_of
from jaxdeform._plotting.sheet import Legend, Sheet


@pytest.mark.parametrize("width", [64, 200, 500, 1000])
def test_numbers_of_the_colour_bar_do_not_touch(monkeypatch, width):
    """Whatever their range: 1e+12 beside 1.3e+12, or -292 beside 292 under a narrow picture."""
    written = []

    def text(pen, place, words, *, anchor, font, **_):
        if anchor == "ma":
            half = font.getlength(words) / 2
            written.append((place[0] - half, place[0] + half))

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    draw = np.random.default_rng(0)
    for _ in range(300):
        low, span = draw.choice([-1.0, 1.0]) * 10 ** draw.uniform(-9, 9), draw.uniform(-6, 12)
        scale = scale_of([np.array([low, low + 10**span])])
        assert scale is not None
        written.clear()
        image = Sheet(width, width, Legend(scale, "rigidity", ())).arrange(
            [np.zeros((width, width, 3), np.uint8)], [()], 1
        )
        assert image.shape[1] == width
        ends = sorted(written)
        assert len(ends) >= 2
        for (_, right), (left, _) in pairwise(ends):
            assert left > right
