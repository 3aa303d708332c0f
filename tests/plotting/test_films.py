"""Films: frames, what is said in them, kinds of files."""

import numpy as np
import pytest
from PIL import Image
from pixels import WIDTH, ink

import jaxdeform as jd
from jaxdeform._plotting import files


def test_a_film_has_a_frame_per_pose(bar, bent, tmp_path):
    path = tmp_path / "bend.gif"
    poses = [bar.vertices + (bent - bar.vertices) * t for t in np.linspace(0, 1, 5)]
    jd.animate(path, bar, poses, values="stretch", seconds=2.0, width=WIDTH)
    with Image.open(path) as film:
        assert film.n_frames == 5
        assert film.info["loop"] == 0
        seen, spent = [], 0
        for k in range(5):
            film.seek(k)
            spent += film.info["duration"]
            seen.append(np.asarray(film.convert("RGB"), int))
    assert spent == 2000
    assert all((image[0, -1] == 255).all() for image in seen)
    # The foot of the sheet is the same in all frames, the mesh is not.
    for image in seen[1:]:
        np.testing.assert_array_equal(image[-20:], seen[0][-20:])
        assert (image != seen[0]).any()


def test_a_walk_around_one_pose(bar, tmp_path):
    path = tmp_path / "turn.gif"
    jd.animate(path, bar, [bar.vertices], turn=90, width=60)
    with Image.open(path) as film:
        assert film.n_frames == 15


def test_a_broken_frame_says_so(bar, bent, exploded, tmp_path):
    path = tmp_path / "broken.gif"
    jd.animate(path, bar, [bar.vertices, exploded, bent], width=WIDTH)
    with Image.open(path) as film:
        heads = []
        for k in range(3):
            film.seek(k)
            heads.append(ink(np.asarray(film.convert("RGB"), int)[:20]).any())
    assert heads == [False, True, False]


def test_films_of_other_kinds(bar, tmp_path, monkeypatch):
    with pytest.raises(jd.InputError, match=r"out\.png: films are GIF or MP4 files"):
        jd.animate(tmp_path / "out.png", bar, [bar.vertices])
    monkeypatch.setattr(files, "find_spec", lambda name: None if "ffmpeg" in name else True)
    with pytest.raises(jd.InputError, match=r"pip install imageio-ffmpeg, or use a \.gif"):
        jd.animate(tmp_path / "out.mp4", bar, [bar.vertices])
    with pytest.raises(jd.InputError, match="values has 3 rows for 2 poses"):
        jd.animate(tmp_path / "out.gif", bar, [bar.vertices] * 2, values=np.ones((3, 722)))


def test_an_mp4_film(bar, bent, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs imageio-ffmpeg")
    jd.animate(tmp_path / "bend.mp4", bar, [bar.vertices, bent, bent], seconds=1.0, width=61)
    frames, _ = ffmpeg.count_frames_and_secs(str(tmp_path / "bend.mp4"))
    assert frames == 3
