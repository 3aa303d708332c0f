"""The images on a mesh, read from the files that its own file names."""

import warnings
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxdeform._errors import InputError, printable
from jaxdeform._mesh.extras import file_texture
from jaxdeform._mesh.images import images_of
from jaxdeform._mesh.mesh import Mesh
from jaxdeform._mesh.reading import read_bytes

# A panel is rarely as wide.
_LARGEST = 4096


class Texture(NamedTuple):
    """An image and the faces that it is on."""

    image: UInt8[np.ndarray, "height width 3"]
    faces: Bool[np.ndarray, "faces"]
    places: Float[np.ndarray, "faces 3 2"]
    """Where in the image each corner is: (0, 0) is its lower left, (1, 1) its upper right."""


def textures_of(mesh: Mesh) -> list[Texture]:
    """Return the images of a mesh. One that cannot be read is left out, with a warning."""
    source = mesh.source
    if source is None:
        return []
    painted = images_of(source)
    at_corners = file_texture(source) if painted else None
    if at_corners is None:
        return []
    sizes, corners = source.polygons
    polygon = np.repeat(np.arange(len(sizes)) * mesh.n_vertices, sizes - 2)
    codes = np.repeat(np.arange(len(sizes)) * mesh.n_vertices, sizes) + corners
    order = np.argsort(codes, kind="stable")
    places = at_corners[order[np.searchsorted(codes[order], polygon[:, None] + mesh.faces)]]
    placed = np.isfinite(places).all(axis=(1, 2))
    out = []
    for path, polygons in painted:
        image, faces = _image(path), np.repeat(polygons, sizes - 2) & placed
        if image is not None and faces.any():
            out.append(Texture(image, faces, places))
    return out


def seen_at_vertices(
    mesh: Mesh, textures: list[Texture], plain: Float[np.ndarray, "vertices 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Return the colour of the images at each vertex, the mean of its corners; plain without."""
    sums, count = np.zeros((mesh.n_vertices, 3)), np.zeros(mesh.n_vertices)
    for image, faces, places in textures:
        height, width = image.shape[:2]
        # Images repeat; but 1 is the end of the first, not the beginning of the second.
        at = places[faces]
        u, v = np.moveaxis(np.where((at >= 0) & (at <= 1), at, at % 1.0), -1, 0)
        row = np.clip((1 - v) * height, 0, height - 1).astype(int)
        column = np.clip(u * width, 0, width - 1).astype(int)
        np.add.at(sums, mesh.faces[faces], image[row, column] / 255)
        np.add.at(count, mesh.faces[faces], 1)
    return np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], plain)


def _image(path: Path) -> UInt8[np.ndarray, "height width 3"] | None:
    from PIL import Image  # comes with pyvista

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(BytesIO(read_bytes(path))) as image:
                image.thumbnail((_LARGEST, _LARGEST))
                return np.asarray(image.convert("RGB"))
    except InputError as error:
        reason = str(error)
    except Exception as error:  # whatever Pillow raises for a broken file
        reason = f"{printable(str(path))}: {error}"
    warnings.warn(f"{reason}: drawn without this image", stacklevel=2)
    return None
