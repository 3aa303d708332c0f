"""For each kind of argument, the values of which none is right."""

from datetime import date
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from good_calls import CELLS, MESH, N

import jaxdeform as jd


class Odd:
    """No number, and no array can be made of it."""

    def __array__(self, *_, **__):
        raise RuntimeError("on another device")


def self_containing() -> list:
    out: list = []
    out.append(out)
    return out


def no_arrays(problem) -> dict:
    """Return values that are no array of numbers, whatever its shape."""
    return {
        "text": "north",
        "number as text": "1.0",
        "bytes": b"12",
        "path": Path("a.obj"),
        "list of texts": ["1.0", "2.0"],
        "dict": {0: 1.0, 1: 2.0},
        "dict view": {0: 1.0}.values(),
        "set": {0, 1},
        "generator": (k for k in range(2)),
        "function": print,
        "class": jd.Mesh,
        "mesh": MESH,
        "pair": (MESH.vertices, MESH.faces),
        "problem": problem,
        "ragged": [[1.0, 2.0], [3.0]],
        "jax ragged": [jnp.ones(2), jnp.ones(3)],
        "jax and text": [jnp.ones(()), "1.0"],
        "jax and complex": [jnp.ones(()), 1j],
        "none in a list": [1.0, None],
        "self-containing": self_containing(),
        "date": date(2024, 1, 1),
        "dates": np.array(["2024-01-01"], "M8[D]"),
        "durations": np.array([3], "m8[s]"),
        "complex": 1.0 + 2.0j,
        "records": np.zeros(3, "f8,i4"),
        "key": jax.random.key(0),
        "huge": 10**5000,
        "huge in a list": [2**70, 0],
        "masked": np.ma.masked,
        "odd": Odd(),
    }


def spoilt(good) -> dict:
    """Return the right shape with the wrong content."""
    good = np.asarray(good)
    masked = np.ma.masked_array(good, np.zeros(good.shape, bool))
    masked[(0,) * good.ndim] = np.ma.masked
    return {
        "texts": good.astype(str),
        "bytes": good.astype("S8"),
        "objects": good.astype(object),
        "dates": good.astype("M8[s]"),
        "complex": good + 0j,
        "jax complex": jnp.asarray(good + 1j),
        "masked": masked,
        "list of masked": [masked],
    }


def wrong_numbers(good, problem) -> dict:
    nan = np.full(np.shape(good), np.nan)
    shapes = {"none left": np.zeros((0, 3)), "too deep": np.zeros((1, 1, 1, 1))}
    return no_arrays(problem) | spoilt(good) | shapes | {"nan": nan, "jax nan": jnp.asarray(nan)}


def wrong_vertices(good, problem) -> dict:
    """Return what chooses no vertices: no indices, no mask, no selection of this mesh."""
    other = jd.shapes.square()
    return wrong_indices(good, problem) | {
        "short mask": np.ones(3, bool),
        "jax short mask": jnp.ones(3, bool),
        "one truth": True,
        "mask of poses": np.ones((2, N), bool),
        "empty mask": np.zeros(N, bool),
        "none": [],
        "selection of another mesh": jd.select.border(other),
        "empty selection": jd.select.where(MESH, "x > 9"),
    }


def wrong_indices(good, problem) -> dict:
    good = np.asarray(good)
    return no_arrays(problem) | {
        **spoilt(good),
        "floats": good + 0.5,
        "whole floats": good.astype(float),
        "negative": good - 10,
        "too large for memory": np.where(np.arange(good.size) == 0, 2**31, good.ravel()),
        "too large for int64": np.full(good.shape, 2**63, np.uint64),
        "largest": np.full(good.shape, 2**63 - 1),
        "too deep": np.zeros((1, 1, 1, 1), int),
    }


NO_SETTING = {
    "text": "3",
    "bytes": b"3",
    "dict": {},
    "list": [3],
    "mesh": MESH,
    "complex": 1j,
    "date": date(2024, 1, 1),
    "class": int,
    "nan": np.nan,
    "inf": np.inf,
    "masked": np.ma.masked,
}
NO_MESH = {
    "text": "a.obj",
    "path": Path("a.obj"),
    "pair": (MESH.vertices, MESH.faces),
    "repaired": jd.repair(MESH),
    "none": None,
    "number": 3,
    "dict": {"vertices": MESH.vertices, "faces": MESH.faces},
    "array": MESH.vertices,
    "class": jd.Mesh,
}
NO_PATH = {
    "none": None,
    "number": 3,
    "bytes": b"a.obj",
    "list": ["a.obj"],
    "mesh": MESH,
    "class": Path,
    "NUL": "a\0.obj",
    "half a character": "\ud800.obj",
}
NO_AXIS = {
    "other letter": "w",
    "two letters": "xy",
    "zero": [0.0, 0.0, 0.0],
    "nan": [np.nan, 0, 0],
    "two": [1.0, 0.0],
    "none": None,
    **spoilt(np.eye(3)[0]),
}
NO_TEXTS = {
    "text": "rest",
    "none": None,
    "numbers": [3],
    "dict": {"rest": 0},
    "too many": ["a"] * 9,
}


def wrong_values(kind: str, good, problem) -> dict:
    """Return values of which none is right for an argument of this kind."""
    table = {
        "numbers": lambda: wrong_numbers(good, problem),
        "indices": lambda: wrong_indices(good, problem),
        "vertices": lambda: wrong_vertices(good, problem),
        "expression": lambda: (
            NO_SETTING
            | {"none": None, "number": 3, "texts": ["y < 1"], "empty": "", "number as text": "3"}
            | {"code": "__import__('os')", "no sign": "y 1", "deep": "(" * 9999, "NUL": "y\0< 1"}
        ),
        "mask": lambda: (
            no_arrays(problem)
            | {
                "numbers": np.ones(N),
                "short": np.ones(3, bool),
                "nothing": [],
                "nothing seen": np.zeros(N, bool),
            }
        ),
        "count": lambda: (
            NO_SETTING
            | {"zero": 0, "negative": -5, "half": 1.5, "whole float": 3.0, "bool": True}
            | {"2**31": 2**31, "huge": 10**5000}
        ),
        "tolerance": lambda: (
            NO_SETTING | {"negative": -1.0, "bool": True, "huge": 10**5000, "array": np.ones(2)}
        ),
        "flag": lambda: NO_SETTING | {"one": 1, "none": None, "array": np.ones(2, bool)},
        "setting": lambda: (
            NO_SETTING
            | {"class": type(good), "unhashable": Unhashable(), "name": type(good).__name__}
        ),
        "mesh": lambda: NO_MESH | {"problem": problem, "cells": CELLS},
        "mesh-like": lambda: {
            "none": None,
            "number": 3,
            "bytes": b"ab",
            "dict": {"vertices": MESH.vertices, "faces": MESH.faces},
            "set": {1, 2},
            "triple": (MESH.vertices, MESH.faces, None),
            "problem": problem,
            "class": jd.Mesh,
        },
        "cells": lambda: NO_MESH | {"none": 2, "problem": problem, "mesh": MESH},
        "problem": lambda: NO_MESH | {"mesh": MESH, "cells": CELLS, "class": jd.Problem},
        "problems": lambda: (
            {f"in a list: {k}": [problem, v] for k, v in NO_MESH.items()}
            | {"alone": problem, "empty": [], "dict": {0: problem}, "text": "ab", "none": None}
        ),
        "path": lambda: NO_PATH,
        "source": lambda: NO_SETTING | {"path": Path("a.obj"), "array": MESH.vertices},
        "axis": lambda: no_arrays(problem) | NO_AXIS,
        "dtype": lambda: NO_SETTING | {"half": np.float16, "integer": int, "name": "north"},
        "prior": lambda: {"list": ["smooth"], "word": "rough", "number": 1, "array": MESH.vertices},
        "metric": lambda: {"none": None, "list": ["auto"], "word": "A", "array": MESH.vertices},
        "progress": lambda: {"text": "print", "number": 5, "mesh": MESH},
        "turn": lambda: NO_SETTING | {"bool": True, "huge": 10**5000, "array": np.ones(2)},
        "label": lambda: {"none": None, "number": 5, "bytes": b"rigidity", "list": ["rigidity"]},
        "titles": lambda: NO_TEXTS,
        "values": lambda: (
            {f"in a list: {k}": [v] for k, v in wrong_numbers(good[0], problem).items()}
            | {"text": "ab", "dict": {0: 1.0}, "none": None, "too many": [1.0] * 9}
        ),
        "poses": lambda: (
            {f"in a list: {k}": [v] for k, v in wrong_numbers(good[0], problem).items()}
            | {"one pose": MESH.vertices, "empty": [], "dict": {0: MESH.vertices}, "text": "ab"}
            | {"wrong size": [MESH.vertices[:-1]], "none": None}
        ),
    }
    return table[kind]()


class Unhashable(jd.QuasiNewton, jd.Newton, jd.Implicit):
    """Every method that a setting needs, but compiled code could not be kept for it."""

    __hash__ = None  # pyright: ignore[reportAssignmentType]
