"""Every argument of every public function, with values of the wrong kind: InputError, at once.

A new function or argument needs a row in good_calls.py, or this fails.
"""

import inspect
import re
from datetime import date
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from good_calls import CELLS, HANDLES, MESH, TARGETS, N, good_calls, kind_of

import jaxdeform as jd


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> dict:
    return good_calls(tmp_path_factory.mktemp("calls"))


# Results and protocols: a user does not make them.
NOT_CALLED = {
    *(
        "Adjoint",
        "Cells",
        "Discrepancy",
        "Estimate",
        "FieldEstimate",
        "HandleFile",
        "InputError",
        "Inspection",
    ),
    *("LocalStep", "Problem", "Result", "RigidGroup", "Selection", "Skeleton", "Solution"),
    "Solver",
    "ThesisEstimate",
    "Verdict",
}
NOT_CALLED |= {"enable_compilation_cache"}  # sets the whole process: apps/test_compilation_cache.py
NO_ARGUMENTS = {"AffineFit", "RotationFit", "Unrolled"}
# What the text may call an argument instead of its name.
SAID = {"handles": "handle", "sources": "source", "weights": "weight", "distances": "distance"}
SAID |= {
    "vertices": "vertex",
    "faces": "face",
    "handle_weights": "weight of handle",
    "parts": "part of",
}


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
        "path": lambda: NO_PATH,
        "source": lambda: NO_SETTING | {"path": Path("a.obj"), "array": MESH.vertices},
        "axis": lambda: no_arrays(problem) | NO_AXIS,
        "dtype": lambda: NO_SETTING | {"half": np.float16, "integer": int, "name": "north"},
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


# Values that an argument may take, though their kind may not.
BATCHES = ("deform_batch", "deform_in_chunks")
PICTURES = ("animate", "render", "render_grid")
ALLOWED = {
    **{(name, "up"): {"none"} for name in PICTURES},  # guessed
    # A broken pose is drawn as far as it goes, and named.
    **{(name, "poses"): {"in a list: nan", "in a list: jax nan"} for name in PICTURES},
    **{(name, "moved"): {"none", "empty mask", "empty selection"} for name in PICTURES},
    **{(name, "memory"): {"2**31"} for name in BATCHES},
    # In a batch only the member is at fault: its result says so.
    **{
        (name, argument): {"nan", "jax nan"}
        for name in BATCHES
        for argument in ("targets", "rigidity", "start")
    },
    ("load_handles", "motion"): {"none"},
    ("select.mask", "mask"): {"nothing seen"},  # a selection may be empty
    ("select.within", "sources"): {"repeated"},
    ("rings", "r"): {"too large for memory", "largest"},  # cells reach as far as the mesh
    ("rc_arap", "r"): {"too large for memory", "largest"},  # it is that of rings
}


FUNCTIONS = {
    name
    for name in jd.__all__
    if callable(getattr(jd, name)) and name not in NOT_CALLED | NO_ARGUMENTS
} | {f"select.{name}" for name in jd.select.__all__}


def test_every_function_and_argument_is_in_the_table(calls):
    assert set(calls) == FUNCTIONS
    for name, (function, arguments) in calls.items():
        assert set(inspect.signature(function).parameters) == set(arguments), name


@pytest.mark.parametrize("function", sorted(FUNCTIONS))
def test_wrong_arguments_are_refused_by_name(calls, function):
    call, arguments = calls[function]
    problem = calls["energy"][1]["problem"]
    wrong = []
    for argument, good in arguments.items():
        values = dict(wrong_values(kind_of(function, argument), good, problem))
        if inspect.signature(call).parameters[argument].default is not None:
            values["None"] = None
        if argument in ("handles", "sources"):
            values["repeated"] = [0, 0, 1]
        for what in values.keys() - ALLOWED.get((function, argument), set()):
            try:
                call(**{**arguments, argument: values[what]})
            except jd.InputError as error:
                text = str(error)
                named = re.search(rf"\b({argument}|{SAID.get(argument, argument)})\b", text)
                if not named or "\n" in text or len(text) > 500:
                    wrong.append(f"{argument}, {what}: says {text[:200]!r}")
            except Exception as error:
                wrong.append(f"{argument}, {what}: {type(error).__name__} {str(error)[:200]!r}")
            else:
                wrong.append(f"{argument}, {what}: taken")
    assert not wrong, "\n".join(wrong)


# ---------------------------------------------------------------- what is told


def test_another_type_is_told_what_makes_the_right_one(calls):
    problem = calls["energy"][1]["problem"]
    told = {
        "problem is a Mesh: call jd.precompute.mesh, handles. first": lambda: jd.deform(
            MESH, TARGETS, 1.0
        ),
        "problem is a str: call jd.precompute.jd.load_mesh": lambda: jd.energy("a", 0, 0, 0),
        "mesh is a str: read it with jd.load_mesh": lambda: jd.precompute("a.obj", HANDLES),
        "mesh is a tuple: make one with jd.Mesh": lambda: jd.rings((MESH.vertices, MESH.faces)),
        r"mesh is a pair: give its first entry, Mesh\(7": lambda: jd.spokes(jd.repair(MESH)),
        "mesh is a Problem: give problem.mesh": lambda: jd.precompute(problem, HANDLES),
        r"cells is an int: give jd.rings\(mesh, r\)": lambda: jd.precompute(MESH, [0], cells=2),
        r"solver is the class QuasiNewton: give QuasiNewton\(\)": lambda: jd.deform(
            problem, TARGETS, 1.0, solver=jd.QuasiNewton
        ),
        "adjoint is a QuasiNewton, without solve: give jd.Implicit": lambda: jd.deform(
            problem, TARGETS, 1.0, adjoint=jd.QuasiNewton()
        ),
        r"handles: the mask has shape \(3,\): give \(7,\), one boolean per vertex": lambda: (
            jd.precompute(MESH, np.ones(3, bool))
        ),
        r"handles must be integers, got float64: give vertex indices, a mask": lambda: (
            jd.precompute(MESH, [0.5])
        ),
        "handles cannot be read as numbers: it holds 1180591620717411303424": lambda: jd.precompute(
            MESH, [2**70, 0]
        ),
        "rigidity cannot be read as numbers: it holds a dict": lambda: jd.deform(
            problem, TARGETS, [{}, 1.0]
        ),
    }
    for message, call in told.items():
        with pytest.raises(jd.InputError, match=message):
            call()


@pytest.mark.parametrize("estimate", [jd.estimate_rigidity, jd.estimate_rigidity_field])
def test_a_mesh_of_handles_has_nothing_to_observe(estimate):
    problem = jd.precompute(MESH, np.arange(N))
    with pytest.raises(jd.InputError, match=r"nothing is free to observe.*leave some out of"):
        estimate(problem, MESH.vertices)


def test_float64_after_jax_was_switched_to_float32(calls):
    """Not four warnings of JAX, which the tests take as errors."""
    problem = calls["energy"][1]["problem"]
    editor = calls["LaplacianEditor"][0]
    jax.config.update("jax_enable_x64", False)
    try:
        for name, call in {
            "problem": lambda: jd.deform(problem, TARGETS, 1.0),
            "this editor": lambda: editor(TARGETS),
        }.items():
            with pytest.raises(jd.InputError, match=f"{name} is float64, but jax_enable_x64"):
                call()
        assert jd.precompute(MESH, HANDLES).dtype == np.float32
    finally:
        jax.config.update("jax_enable_x64", True)
