"""Pictures of meshes."""

import pytest

import jaxdeform as jd


def test_pictures_of_a_bad_name(bar, tmp_path):
    with pytest.raises(jd.InputError, match=r"use a \.png name"):
        jd.render(tmp_path / "bar.jpg", bar, [bar.vertices])
