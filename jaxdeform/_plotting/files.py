"""Pictures as files: PNG, GIF and MP4."""

import subprocess
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from jaxdeform._errors import InputError
from jaxdeform._mesh.writing import check_place, write_atomically

# Ordered dithering (Bayer 1973), from -6 to 6 of 255.
_PATTERN = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) * 0.8 - 6.0

Picture = UInt8[np.ndarray, "_ _ 3"]


def check_picture_path(path: Path, *suffixes: str) -> None:
    """Raise InputError if no picture of these kinds (by default PNG) can be written there."""
    suffixes = suffixes or (".png",)
    if path.suffix.lower() not in suffixes:
        kinds = " or ".join(suffix[1:].upper() for suffix in suffixes)
        kind = "pictures" if ".png" in suffixes else "films"
        raise InputError(f"{path}: {kind} are {kinds} files: use a {' or '.join(suffixes)} name")
    check_can_draw()
    if path.suffix.lower() == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise InputError(
            f"{path}: MP4 films need imageio-ffmpeg: pip install imageio-ffmpeg, or use a .gif name"
        )
    check_place(path)


def check_can_draw() -> None:
    """Raise InputError where pyvista is not installed."""
    if find_spec("pyvista") is None:
        raise InputError("pictures need pyvista: pip install 'jaxdeform[viewer]'")


def png(image: Picture) -> bytes:
    """Return a picture as a PNG file."""
    from PIL import Image  # comes with pyvista

    content = BytesIO()
    Image.fromarray(image).save(content, format="PNG", optimize=True)
    return content.getvalue()


def write_png(path: Path, image: Picture) -> None:
    """Write a picture, as a whole or not at all."""
    write_atomically(path, png(image))


def write_film(path: Path, images: Sequence[Picture], milliseconds: int) -> None:
    """Write a GIF or an MP4 file, as a whole or not at all."""
    film = _gif if path.suffix.lower() == ".gif" else _mp4
    write_atomically(path, film(images, milliseconds))


def _gif(images: Sequence[Picture], milliseconds: int) -> bytes:
    """Return a film that repeats. All frames have the same colours, so none flickers."""
    from PIL import Image

    colors = _palette(images)
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors.tobytes())
    frames = []
    for image in images:
        # A fixed pattern of lighter and darker points hides the steps between colours.
        tiles = [-(-n // 4) for n in image.shape[:2]]
        mixed = image + np.tile(_PATTERN, tiles)[: image.shape[0], : image.shape[1], None]
        mixed = Image.fromarray(mixed.clip(0, 255).astype(np.uint8))
        near = mixed.quantize(palette=palette, dither=Image.Dither.NONE)
        # Pillow looks up colours by their first bits: white would become nearly white.
        index = np.where((image == 255).all(axis=2), 0, np.asarray(near)).astype(np.uint8)
        frames.append(Image.fromarray(index))
        frames[-1].putpalette(colors.tobytes())
    first, *others = frames
    content = BytesIO()
    first.save(
        content,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=milliseconds,
        loop=0,
        optimize=False,
    )
    return content.getvalue()


def _palette(images: Sequence[Picture]) -> UInt8[np.ndarray, "256 3"]:
    """Return the colours of a film: white, and those that cover the rest of its frames best."""
    from PIL import Image

    pixels = np.concatenate([image.reshape(-1, 3) for image in images[:: len(images) // 12 + 1]])
    pixels = np.append(pixels[(pixels != 255).any(axis=1)], [[0, 0, 0]], axis=0).astype(np.uint8)
    few = Image.fromarray(pixels[None]).quantize(255, kmeans=1, dither=Image.Dither.NONE)
    found = np.array(few.getpalette(), np.uint8).reshape(-1, 3)
    out = np.full((256, 3), 255, np.uint8)
    out[1 : 1 + len(found)] = found[:255]
    return out


def _mp4(images: Sequence[Picture], milliseconds: int) -> bytes:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    # H.264 takes even sizes only.
    height, width = (2 * (n // 2) for n in images[0].shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        name = Path(folder) / "film.mp4"
        command = [
            imageio_ffmpeg.get_ffmpeg_exe(),
            *("-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"),
            *("-s", f"{width}x{height}", "-r", f"{1000 / milliseconds:.6g}", "-i", "-"),
            *("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", str(name)),
        ]
        frames = b"".join(image[:height, :width].tobytes() for image in images)
        subprocess.run(command, input=frames, check=True)
        return name.read_bytes()
