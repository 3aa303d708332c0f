"""The columns of a manifest: one reader each, which checks a cell."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import jaxdeform as jd
from jaxdeform._apps.methods import Method
from jaxdeform._apps.results import RESCUED
from jaxdeform._errors import a_or_an, shown
from jaxdeform._handles.files import motion_beside
from jaxdeform._mesh.expressions import matching
from jaxdeform._mesh.words import real

# The results of a run are those of methods that have an energy.
_METHODS = [str(method) for method in Method if method.has_energy]


def _name(value: Any, folder: Path) -> str:
    name = str(value).strip()
    if name in (".", "..") or set(name) & set('/\\:*?"<>|\0') or not name.isprintable():
        raise jd.InputError(f"{shown(name)} cannot name a file: leave out signs such as / and :")
    if len(f"{name}{RESCUED}".encode()) > 255:  # the longest that file systems take
        raise jd.InputError(
            f"{shown(name)} is too long for the name of a file: give at most "
            f"{255 - len(RESCUED)} bytes"
        )
    return name


def _file(value: Any, folder: Path) -> str:
    if not isinstance(value, str):
        raise jd.InputError(f"is {a_or_an(value)}: give the name of a file")
    try:
        path = (folder / value.strip()).resolve()
        found = path.is_file()
    except (OSError, ValueError) as error:
        raise jd.InputError(f"{shown(value)} is no name of a file ({error})") from error
    if not path.is_relative_to(folder):
        raise jd.InputError(
            f"{shown(value)} is outside the manifest's folder: put it beside the manifest"
        )
    if not found:
        raise jd.InputError(f"there is no file {path}: check the name")
    return str(path)


def _handles(value: Any, folder: Path) -> str:
    name = _file(value, folder)
    beside = motion_beside(Path(name))
    if beside is not None:
        _file(str(beside), folder)
    return name


def _files(value: Any, folder: Path) -> tuple[str, ...]:
    return tuple(_file(one, folder) for one in _listed(value, ";"))


# A solid, on which every expression that can be read has a value.
_SOLID = jd.Mesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def _expression(value: Any, folder: Path) -> str:
    matching(_SOLID, value, "the expression")
    return value.strip()


def _numbers(value: Any, count: int) -> tuple[float, ...]:
    words = _listed(value, None)
    numbers = [_number(word) for word in words]
    if len(numbers) != count or None in numbers:
        raise jd.InputError(f"{shown(value)}: give {count} numbers, such as 0 0.5 1")
    return tuple(x for x in numbers if x is not None)


def _point(value: Any, folder: Path) -> tuple[float, ...]:
    return _numbers(value, 3)


def _rotation(value: Any, folder: Path) -> tuple[str, float]:
    words = _listed(value, None)
    degrees = _number(words[-1]) if len(words) == 2 else None
    if degrees is None or words[0] not in ("x", "y", "z"):
        raise jd.InputError(f"{shown(value)}: give an axis and degrees, such as z 60")
    return str(words[0]), degrees


def _listed(value: Any, mark: str | None) -> list[Any]:
    if isinstance(value, str):
        return value.split(mark)
    return value if isinstance(value, list) else [value]


def _number(word: Any) -> float | None:
    number = _real(word)
    return number if number is not None and math.isfinite(number) else None


def _real(word: Any) -> float | None:
    """Return the number of a word, which may be infinite or NaN."""
    try:
        return real(str(word).strip().encode(errors="replace"))
    except ValueError:
        return None


def _count(value: Any, folder: Path) -> int:
    number = None if isinstance(value, bool) else _number(value)
    if number is None or number != int(number) or not 1 <= number <= 9999:
        raise jd.InputError(f"{shown(value)}: give a whole number from 1 to 9999")
    return int(number)


def _method(value: Any, folder: Path) -> str:
    if value not in _METHODS:
        raise jd.InputError(f"{shown(value)} is no method: there are {', '.join(_METHODS)}")
    return value


def _alpha(value: Any, folder: Path) -> float:
    number = _number(value)
    if number is None or number < 0:
        raise jd.InputError(f"{shown(value)}: give a number, 0 or more")
    return number


def _rigidity(value: Any, folder: Path) -> str:
    number = _real(value)
    if number is None and isinstance(value, str):
        return _file(value, folder)
    if number is None or not 0 <= number < math.inf:
        raise jd.InputError(f"{shown(value)}: give a number, 0 or more, or a PLY file")
    return repr(number)


def _regions(value: Any, folder: Path) -> tuple[str, ...]:
    found = []
    for region in _listed(value, ";"):
        expression, _, word = str(region).rpartition(":")
        number = _number(word)
        if number is None or number < 0:
            raise jd.InputError(f"{shown(region)}: give EXPR: VALUE, such as y > 0.5: 30")
        found.append(f"{_expression(expression, folder)}: {number!r}")
    return tuple(found)


READERS: dict[str, Callable[[Any, Path], Any]] = {
    "job": _name,
    "mesh": _file,
    "handles": _handles,
    "fix": _expression,
    "move": _expression,
    "rotate": _rotation,
    "about": _point,
    "translate": _point,
    "frames": _count,
    "method": _method,
    "rigidity": _rigidity,
    "stiff": _regions,
    "rings": _count,
    "poses": _files,
    "alpha": _alpha,
}
