"""The images that a file paints its polygons with.

An OBJ file names libraries (.mtl), in which a material names the image of its colour (map_Kd). A
PLY file names one image in a comment, as MeshLab writes it.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxdeform._mesh.obj import material_of_faces
from jaxdeform._mesh.parsed import Source
from jaxdeform._mesh.reading import without_mark

_PLY_IMAGE = re.compile(rb"^comment TextureFile[ \t]+(.+?)\s*$", re.MULTILINE)
# Each option of a map begins with a minus, and has numbers, on or off, or a letter behind it.
_OPTIONS = re.compile(rb"^(-[a-z]+(\s+(-?[\d.]+(e-?\d+)?|on|off|[rgbmlz]))*\s+)*", re.IGNORECASE)


class Painted(NamedTuple):
    """Polygons of one image."""

    image: Path
    polygons: Bool[np.ndarray, "polygons"]


def images_of(source: Source) -> list[Painted]:
    """Return the images that the file names, whether they are there or not."""
    data, count = without_mark(source.data), len(source.polygons.sizes)
    if source.suffix == ".ply":
        found = _PLY_IMAGE.search(data[: max(data.find(b"end_header"), 0)])
        image = _place(source.path.parent, found[1]) if found else None
        return [Painted(image, np.ones(count, bool))] if image else []
    if source.suffix != ".obj":
        return []
    libraries, used = material_of_faces(data)
    images: dict[bytes, Path] = {}
    for name in libraries:
        library = _place(source.path.parent, name)
        if library is not None and library.is_file():
            images |= _images_of_materials(library)
    names = np.array(used, object)
    return [Painted(image, names == name) for name, image in images.items() if name in used]


def _images_of_materials(library: Path) -> dict[bytes, Path]:
    images: dict[bytes, Path] = {}
    material = b""
    for line in library.read_bytes().splitlines():
        keyword, _, rest = line.strip().partition(b" ")
        if keyword.lower() == b"newmtl":
            material = rest.strip()
        elif keyword.lower() == b"map_kd":
            place = _place(library.parent, _OPTIONS.sub(b"", rest.strip(), count=1))
            if place is not None:
                images[material] = place
    return images


def _place(folder: Path, name: bytes) -> Path | None:
    """Return the file of this name, beside the file that names it if it is nowhere else."""
    text = name.decode(errors="replace").replace("\\", "/").strip('"')
    if not text or "\0" in text:
        return None
    place = folder / text
    return place if place.is_file() else folder / Path(text).name
