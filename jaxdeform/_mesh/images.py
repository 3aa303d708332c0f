"""The images that a file paints its polygons with.

An OBJ file names libraries (.mtl), in which a material names the image of its colour (map_Kd). A
PLY file names one image in a comment, as MeshLab writes it.
"""

import os
import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxdeform._errors import InputError
from jaxdeform._mesh.obj import material_of_faces
from jaxdeform._mesh.parsed import Source
from jaxdeform._mesh.reading import read_bytes, without_mark

_PLY_IMAGE = re.compile(rb"comment\s+TextureFile\s+(.*\S)")
# Each option of a map begins with a minus. What stands behind it: a name, or numbers and the like.
_VALUE = rb"[-+]?[\d.]+(e[-+]?\d+)?|on|off|[rgbmlz]"
_OPTIONS = re.compile(
    rb"(-(type|colorspace)\s+\S+\s+|-[a-z]+(\s+(" + _VALUE + rb"))*\s+)*", re.IGNORECASE
)


class Painted(NamedTuple):
    """The polygons of one image."""

    image: Path
    polygons: Bool[np.ndarray, "polygons"]


def images_of(source: Source) -> list[Painted]:
    """Return the images that the file names, whether they are there or not."""
    data = without_mark(source.data)
    if source.suffix == ".ply":
        return _images_of_ply(source, data)
    return _images_of_obj(source, data) if source.suffix == ".obj" else []


def _images_of_ply(source: Source, data: bytes) -> list[Painted]:
    header = data[: max(data.find(b"end_header"), 0)].splitlines()
    named = {found[1] for line in header if (found := _PLY_IMAGE.fullmatch(line.strip()))}
    if len(named) > 1:
        warnings.warn(
            f"{source.path}: names {len(named)} images, of which PLY does not say where they "
            "belong: drawn without them",
            stacklevel=2,
        )
        return []
    everywhere = np.ones(len(source.polygons.sizes), bool)
    return [Painted(_place(source.path.parent, name), everywhere) for name in named]


def _images_of_obj(source: Source, data: bytes) -> list[Painted]:
    if b"mtllib" not in data.lower():  # its lines need not be taken apart
        return []
    libraries, used = material_of_faces(data)
    of_material: dict[bytes, Path] = {}
    for names in libraries:
        for library in _libraries(source.path.parent, names):
            of_material |= _images_of_materials(library)
    # A comment may follow; but a name may have the sign of one in it.
    image = np.array([of_material.get(x) or of_material.get(_bare(x)) for x in used], object)
    return [Painted(path, image == path) for path in dict.fromkeys(of_material.values())]


def _libraries(folder: Path, names: bytes) -> list[Path]:
    """Return the libraries of a line: one with spaces in its name, or several."""
    for words in ([names], [_bare(names)], _bare(names).split()):
        places = [_place(folder, word) for word in words]
        if all(map(_is_file, places)):
            return places
    return []


def _images_of_materials(library: Path) -> dict[bytes, Path]:
    try:
        data = without_mark(read_bytes(library))
    except InputError as error:
        warnings.warn(f"{error}: drawn without its images", stacklevel=2)
        return {}
    images: dict[bytes, Path] = {}
    material = None
    for line in data.splitlines():
        keyword, *rest = line.split(None, 1)[:2] or [b""]
        name = rest[0].strip() if rest else b""
        if keyword.lower() == b"newmtl":
            material = name
        elif keyword.lower() == b"map_kd" and material is not None:
            name = name[_OPTIONS.match(name).end() :]  # pyright: ignore[reportOptionalMemberAccess]
            place = _place(library.parent, name)
            images[material] = place if _is_file(place) else _place(library.parent, _bare(name))
    return images


def _bare(name: bytes) -> bytes:
    """Return the name without a comment behind it."""
    return name.split(b" #", 1)[0].rstrip()


def _place(folder: Path, name: bytes) -> Path:
    """Return the file of this name, beside the file that names it if it is nowhere else."""
    text = os.fsdecode(name).replace("\\", "/").strip('"')
    place = folder / text
    return place if _is_file(place) else folder / Path(text).name


def _is_file(place: Path) -> bool:
    try:
        return place.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False
