"""Every argument of every public function, with values of the wrong kind: InputError, at once.

A new function or argument needs a row in good_calls.py, or this fails.
"""

import inspect
import re

import jax
import numpy as np
import pytest
from good_calls import FUNCTIONS, HANDLES, MESH, TARGETS, N, good_calls, kind_of
from wrong_values import wrong_values

import jaxdeform as jd


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> dict:
    return good_calls(tmp_path_factory.mktemp("calls"))


# What the text may call an argument instead of its name.
SAID = {"handles": "handle", "sources": "source", "weights": "weight", "distances": "distance"}
SAID |= {
    "vertices": "vertex",
    "faces": "face",
    "handle_weights": "weight of handle",
    "parts": "part of",
    "problems": "problem",
}

# Values that an argument may take, though their kind may not.
BATCHES = ("deform_batch", "deform_in_chunks")
PICTURES = ("animate", "render", "render_grid")
ALLOWED = {
    **{(name, "up"): {"none"} for name in (*PICTURES, "show")},  # guessed
    # A broken pose is drawn as far as it goes, and named.
    **{(name, "poses"): {"in a list: nan", "in a list: jax nan"} for name in PICTURES},
    ("show", "poses"): {"none"},  # the rest shape
    **{(name, "moved"): {"none", "empty mask", "empty selection"} for name in (*PICTURES, "show")},
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
    coarse = jd.coarsen(problem, 6)
    jax.config.update("jax_enable_x64", False)
    try:
        for name, call in (
            ("problem", lambda: jd.deform(problem, TARGETS, 1.0)),
            ("problem", lambda: coarse.start(TARGETS, 1.0)),
            ("this editor", lambda: editor(TARGETS)),
        ):
            with pytest.raises(jd.InputError, match=f"{name} is float64, but jax_enable_x64"):
                call()
        assert jd.precompute(MESH, HANDLES).dtype == np.float32
    finally:
        jax.config.update("jax_enable_x64", True)
