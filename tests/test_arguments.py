"""Every argument of every public function, with values of the wrong kind: InputError, at once.

One table holds a good call of each function, another the kind of each argument. A new function or
argument without a row fails here.
"""

import inspect
from datetime import date
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CUBE, EXACT
from small_meshes import small_mesh

import jaxdeform as jd

MESH = small_mesh()
HANDLES = [0, 1, 2, 3, 5]
TARGETS = MESH.vertices[HANDLES] * 1.1
CELLS = jd.rings(MESH)
PIECE = jd.submesh(MESH, [4])
N, EDGES = MESH.n_vertices, len(MESH.edges)
TWO = np.array([[0.0, 0.0, 0.1], [0.2, 0.0, 0.0]])
SKIN = {
    "vertices": MESH.vertices,
    "weights": np.full((N, 2), 0.5),
    "transforms": np.stack([np.eye(3, 4), np.eye(3, 4)]),
}
WEIGHTS = {"vertices": MESH.vertices, "controls": TWO, "distances": np.ones((N, 2))}


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> dict:
    """Return a good call of each function: the function, and all its arguments by name."""
    folder = tmp_path_factory.mktemp("arguments")
    obj, ply, tgf, sel = (folder / name for name in ("m.obj", "m.ply", "m.tgf", "h.sel"))
    jd.save_mesh(obj, MESH)
    jd.save_mesh(ply, MESH, rigidity=1.0)
    tgf.write_text("1 0 0 0\n2 0 1 0\n#\n1 2\n")
    sel.write_text("0\n" * N)
    (folder / "h.def").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    problem = jd.precompute(MESH, HANDLES)
    soft = jd.precompute(MESH, HANDLES, handle_weights=1.0)
    editor = jd.laplacian_editor(MESH, HANDLES)
    observed = {
        "problem": problem,
        "observed": MESH.vertices,
        "targets": TARGETS,
        "mask": np.ones(N, bool),
        "start": 1.0,
        "solver": jd.QuasiNewton(),
        "max_evaluations": 5,
    }
    fit = {**observed, "adjoint": jd.Implicit(), "progress": print}
    edit = {
        "mesh": MESH,
        "handles": HANDLES,
        "weights": np.ones(EDGES),
        "handle_weights": np.ones(5),
        "similarity": False,
    }
    move = {"points": MESH.vertices, "degrees": 30.0}
    return {
        "Alternating": (jd.Alternating, {"steps": 3, "tolerance": 1e-3}),
        "GradientDescent": (jd.GradientDescent, {"max_steps": 3}),
        "Implicit": (jd.Implicit, {"tolerance": 1e-3, "max_steps": 3}),
        "LBFGS": (jd.LBFGS, {"tolerance": 1e-3, "max_steps": 3}),
        "Mesh": (jd.Mesh, {"vertices": MESH.vertices, "faces": MESH.faces}),
        "Newton": (jd.Newton, {"max_steps": 3}),
        "QuasiNewton": (
            jd.QuasiNewton,
            {"tolerance": 1e-3, "max_steps": 3, "history_length": 3},
        ),
        "LaplacianEditor": (editor, {"targets": TARGETS}),
        "Submesh": (PIECE.reinsert, {"vertices": PIECE.mesh.vertices, "base": MESH.vertices}),
        "bend": (jd.bend, {**move, "along": "y", "toward": "x"}),
        "bounded_biharmonic_weights": (
            jd.bounded_biharmonic_weights,
            {"mesh": MESH, "handles": [0, 1, 2], "group": [0, 1, 0]},
        ),
        "cotangent_weights": (jd.cotangent_weights, {"mesh": MESH}),
        "deform": (
            jd.deform,
            {
                "problem": soft,
                "targets": TARGETS,
                "rigidity": np.ones(N),
                "local": jd.Newton(),
                "solver": jd.QuasiNewton(),
                "start": MESH.vertices,
                "handle_weights": np.ones(5),
                "normals": False,
                "adjoint": jd.Implicit(),
            },
        ),
        "dual_quaternion_skinning": (jd.dual_quaternion_skinning, SKIN),
        "energy": (
            jd.energy,
            {
                "problem": problem,
                "vertices": MESH.vertices,
                "transforms": np.tile(np.eye(3), (N, 1, 1)),
                "rigidity": 1.0,
            },
        ),
        "estimate_rigidity": (
            jd.estimate_rigidity,
            {**fit, "parts": np.zeros(N, int), "displacement_tolerance": 1e-2},
        ),
        "estimate_rigidity_field": (jd.estimate_rigidity_field, {**fit, "smoothness": 1e-4}),
        "estimate_rigidity_thesis": (
            jd.estimate_rigidity_thesis,
            {k: v for k, v in observed.items() if k != "mask"}
            | {"step_size": 0.01, "threshold": 1e-3},
        ),
        "find_handle_groups": (
            jd.find_handle_groups,
            {"mesh": MESH, "deformed": MESH.vertices, "tolerance": 1e-6},
        ),
        "find_handles": (
            jd.find_handles,
            {"mesh": MESH, "deformed": MESH.vertices, "tolerance": 1e-6},
        ),
        "geodesic_distances": (jd.geodesic_distances, {"mesh": MESH, "sources": [0, 1]}),
        "inspect": (jd.inspect, {"mesh": MESH}),
        "inverse_distance_weights": (jd.inverse_distance_weights, {**WEIGHTS, "power": 2.0}),
        "laplacian_editing": (jd.laplacian_editing, {**edit, "targets": TARGETS}),
        "laplacian_editor": (jd.laplacian_editor, edit),
        "linear_blend_skinning": (jd.linear_blend_skinning, SKIN),
        "load_handles": (
            jd.load_handles,
            {"path": sel, "mesh": MESH, "motion": folder / "h.def"},
        ),
        "load_mesh": (jd.load_mesh, {"path": obj}),
        "load_rigidity": (jd.load_rigidity, {"path": ply}),
        "load_skeleton": (jd.load_skeleton, {"path": tgf}),
        "mean_value_coordinates": (
            jd.mean_value_coordinates,
            {"vertices": 0.5 * CUBE.vertices, "cage": CUBE},
        ),
        "precompute": (
            jd.precompute,
            {
                "mesh": MESH,
                "handles": HANDLES,
                "cells": CELLS,
                "handle_weights": np.ones(5),
                "dtype": np.float64,
            },
        ),
        "render": (
            jd.render,
            {
                "path": folder / "m.png",
                "mesh": MESH,
                "poses": [MESH.vertices],
                "titles": ["rest"],
                "values": [np.ones(N)],
                "label": "rigidity",
                "width": 64,
            },
        ),
        "repair": (jd.repair, {"mesh": MESH}),
        "rigid_targets": (
            jd.rigid_targets,
            {
                "points": TARGETS,
                "group": [0, 0, 1, 1, 1],
                "rotations": TWO,
                "translations": TWO,
                "centers": TWO,
            },
        ),
        "rigid_transforms": (
            jd.rigid_transforms,
            {"rotations": TWO, "translations": TWO, "centers": TWO},
        ),
        "rigid_weights": (jd.rigid_weights, WEIGHTS),
        "rigidity_from_material": (
            jd.rigidity_from_material,
            {"problem": problem, "constant": np.ones(N)},
        ),
        "rings": (jd.rings, {"mesh": MESH, "r": np.ones(N, int), "weights": np.ones(EDGES)}),
        "rotate": (jd.rotate, {**move, "axis": [0.0, 1.0, 0.0], "center": [0.0, 0.0, 1.0]}),
        "save_mesh": (
            jd.save_mesh,
            {"path": ply, "mesh": MESH, "vertices": MESH.vertices, "rigidity": np.ones(N)},
        ),
        "spokes": (jd.spokes, {"mesh": MESH, "weights": np.ones(EDGES)}),
        "submesh": (jd.submesh, {"mesh": MESH, "free": [4], "cells": CELLS}),
        "translate": (jd.translate, {"points": MESH.vertices, "offset": [1.0, 2.0, 3.0]}),
        "twist": (jd.twist, {**move, "along": "y"}),
    }


OF_KIND = {
    "numbers": "base center centers constant controls deformed degrees distances handle_weights "
    "observed offset points power rigidity rotations start targets transforms translations "
    "vertices weights",
    "indices": "faces free group handles parts r sources",
    "count": "history_length max_evaluations max_steps steps width",
    "tolerance": "displacement_tolerance smoothness step_size threshold tolerance",
    "path": "path motion",
    "setting": "adjoint local solver",
    "flag": "normals similarity",
    "axis": "axis along toward",
    "mesh": "mesh cage",
}
KINDS = {name: kind for kind, names in OF_KIND.items() for name in names.split()}
KINDS_HERE = {
    ("estimate_rigidity_thesis", "start"): "tolerance",
    ("inspect", "mesh"): "mesh-like",
    ("repair", "mesh"): "mesh-like",
}
# Results and protocols: a user does not make them.
NOT_CALLED = {
    *("Adjoint", "Cells", "Estimate", "FieldEstimate", "HandleFile", "InputError", "Inspection"),
    *("LocalStep", "Problem", "Result", "RigidGroup", "Skeleton", "Solution", "Solver"),
    "ThesisEstimate",
}
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
        "axis": lambda: no_arrays(problem) | NO_AXIS,
        "dtype": lambda: NO_SETTING | {"half": np.float16, "integer": int, "name": "north"},
        "progress": lambda: {"text": "print", "number": 5, "mesh": MESH},
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


def kind_of(function: str, argument: str) -> str:
    """Return the kind of an argument: a key of the table below."""
    return KINDS_HERE.get((function, argument)) or KINDS.get(argument, argument)


# Values that an argument may take, though their kind may not.
ALLOWED = {
    ("load_handles", "motion"): {"none"},
    ("rings", "r"): {"too large for memory", "largest"},  # cells reach as far as the mesh
}


FUNCTIONS = {
    name
    for name in jd.__all__
    if callable(getattr(jd, name)) and name not in NOT_CALLED | NO_ARGUMENTS
}


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
        required = inspect.signature(call).parameters[argument].default is inspect.Parameter.empty
        values = dict(wrong_values(kind_of(function, argument), good, problem))
        if required:
            values["None"] = None
        for what in values.keys() - ALLOWED.get((function, argument), set()):
            try:
                call(**{**arguments, argument: values[what]})
            except jd.InputError as error:
                text = str(error)
                named = argument in text or SAID.get(argument, argument) in text
                if not named or "\n" in text or len(text) > 500:
                    wrong.append(f"{argument}, {what}: says {text[:200]!r}")
            except Exception as error:
                wrong.append(f"{argument}, {what}: {type(error).__name__} {str(error)[:200]!r}")
            else:
                wrong.append(f"{argument}, {what}: taken")
    assert not wrong, "\n".join(wrong)


# ---------------------------------------------------------------- what is taken

QUICK = [
    *("Mesh", "bend", "energy", "find_handles", "inverse_distance_weights", "rigid_transforms"),
    *("linear_blend_skinning", "mean_value_coordinates", "rigid_targets", "rotate", "spokes"),
    *("rigidity_from_material", "submesh", "translate", "twist", "LaplacianEditor", "Submesh"),
]
OTHER_FORMS = {
    "other byte order": lambda x: x.astype(x.dtype.newbyteorder("S")),
    "long double": lambda x: x.astype(np.longdouble) if x.dtype.kind == "f" else x.astype("u1"),
    "columns first": lambda x: np.array(x, order="F"),
    "read-only": lambda x: np.broadcast_to(x, x.shape),
    "list": lambda x: x.tolist(),
    "JAX's": jnp.asarray,
    "list of JAX's": lambda x: list(jnp.asarray(x)) if x.ndim else x,
    "nothing masked": np.ma.masked_array,
}


def numbers_of(result) -> list[np.ndarray]:
    """Return all arrays in a result, which may be a mesh."""
    if isinstance(result, jd.Mesh):
        return [result.vertices, result.faces]
    if isinstance(result, jd.Cells):
        return [result.weights]
    if isinstance(result, jd.Submesh):
        return [result.index]
    return list(map(np.asarray, jax.tree.leaves(result)))


@pytest.mark.parametrize("function", QUICK)
def test_every_form_of_an_array_gives_the_same(calls, function):
    call, arguments = calls[function]
    want = numbers_of(call(**arguments))
    arrays = {
        name: np.asarray(value)
        for name, value in arguments.items()
        if kind_of(function, name) in ("numbers", "indices")
    }
    for what, form in OTHER_FORMS.items():
        got = numbers_of(call(**arguments | {name: form(x) for name, x in arrays.items()}))
        for a, b in zip(got, want, strict=True):
            np.testing.assert_allclose(a, b, rtol=EXACT, atol=EXACT, err_msg=what)


def test_a_list_may_hold_what_jax_traces():
    """As the rows of targets of which one is the unknown."""

    def height(angle):
        rows = [[1.0, 0.0, angle], [0.0, 1, 2.0]]
        return jnp.sum(jd.linear_blend_skinning(rows, np.full((2, 2), 0.5), SKIN["transforms"]))

    assert jax.jit(jax.grad(height))(0.3) == 1.0


@pytest.mark.parametrize(
    ("function", "argument"),
    [("Mesh", "vertices"), ("Mesh", "faces"), ("precompute", "handles"), ("submesh", "free")],
)
def test_what_numpy_works_out_cannot_be_traced(calls, function, argument):
    call, arguments = calls[function]
    given = jnp.asarray(arguments[argument])
    for traced in (given, list(given)):
        with pytest.raises(jd.InputError, match=rf"{argument}: traced by JAX .*known numbers"):
            jax.jit(lambda x: call(**arguments | {argument: x}))(traced)


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
        r"handles must be integers, got bool.*np.flatnonzero": lambda: jd.precompute(
            MESH, np.ones(N, bool)
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
