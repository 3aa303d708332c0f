"""Every public function with random arguments of the right types: an InputError, or sound results.

test_arguments.py gives values of wrong types, one at a time. Here several arguments change at once,
and each value is one that a program may well pass: any number, index, direction or mesh.
For a long run set JAXDEFORM_RANDOM_CALLS to the number of calls of each function.
"""

import os
import warnings
from collections.abc import Iterator

import equinox as eqx
import hypothesis.extra.numpy as hnp
import jax
import numpy as np
import pytest
from good_calls import FUNCTIONS, MESH, N, good_calls, kind_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxdeform as jd

pytestmark = pytest.mark.slow

EXAMPLES = int(os.environ.get("JAXDEFORM_RANDOM_CALLS", "3"))
# Files are the business of fuzz.py, pictures that of tests/plotting.
LEFT_OUT = {"animate", "render", "render_grid", "show", "save_mesh", "load_handles", "load_mesh"}
LEFT_OUT |= {"load_rigidity", "load_skeleton"}


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> dict:
    return good_calls(tmp_path_factory.mktemp("calls"))


# Lengths beyond are refused (docs/limits.md): their squares are near the range of float64.
LARGEST = 1e140
NUMBERS = st.one_of(
    st.floats(-10.0, 10.0),
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-300, 1e12, 1e-12, 5e-324, np.nan, np.inf, -np.inf]),
    st.floats(-LARGEST, LARGEST),
)


def numbers_like(good) -> st.SearchStrategy:
    """Return arrays of the same shape: good ones at another scale, moved, or any numbers."""
    good = np.asarray(good, float)
    scaled = st.sampled_from([0.0, -1.0, 1e-9, 0.5, 1e9, 1e100, 1e-100]).map(lambda x: x * good)
    moved = st.sampled_from([1e-6, 1.0, 1e6, 1e15]).map(lambda x: x + good)
    return st.one_of(scaled, moved, hnp.arrays(float, good.shape, elements=NUMBERS))


def indices_like(good) -> st.SearchStrategy:
    return hnp.arrays(int, np.shape(good), elements=st.integers(-1, N))


MESHES = st.tuples(
    numbers_like(MESH.vertices), st.one_of(st.just(MESH.faces), indices_like(MESH.faces))
)


def mesh_of(points, faces) -> jd.Mesh:
    """Return a mesh of any points and faces, or MESH where they make none."""
    try:
        return jd.Mesh(points, faces)
    except jd.InputError:
        return MESH


def strategy_of(kind: str, good) -> st.SearchStrategy | None:
    """Return what an argument of a kind may be, or None where only the good value makes sense."""
    table = {
        "numbers": lambda: numbers_like(good),
        "indices": lambda: indices_like(good),
        "vertices": lambda: st.one_of(
            st.lists(st.integers(0, N - 1), min_size=1, max_size=N, unique=True),
            hnp.arrays(bool, N),
            indices_like(good),
        ),
        "mask": lambda: hnp.arrays(bool, N),
        "count": lambda: st.integers(1, 4),
        "tolerance": lambda: NUMBERS,
        "flag": st.booleans,
        "axis": lambda: st.one_of(st.sampled_from("xyz"), numbers_like(np.ones(3))),
        "mesh": lambda: MESHES,
        "prior": lambda: st.sampled_from(["smooth", "total_variation"]),
        "metric": lambda: st.sampled_from(["auto", "material", "stiffness"]),
    }
    return table[kind]() if kind in table else None


def unsound(out) -> str | None:
    """Return what is wrong with a result: NaN that no `result` speaks of; in a pose, infinity."""
    for part in jax.tree.leaves(out, is_leaf=lambda x: hasattr(x, "result")):
        said = getattr(part, "result", None)
        if said is not None and not bool(np.all(said == jd.Result.converged)):
            continue
        bad = np.isnan if not isinstance(part, jd.Solution) else lambda x: ~np.isfinite(x)
        arrays = map(np.asarray, jax.tree.leaves(eqx.filter(part, eqx.is_array)))
        if any(bad(x).any() for x in arrays if x.dtype.kind == "f"):
            return f"not finite, but {'Converged' if said is not None else 'nothing is said'}"
    return None


@pytest.mark.parametrize("function", sorted(FUNCTIONS - LEFT_OUT))
def test_random_arguments(calls, function):
    call, good = calls[function]
    found = {name: strategy_of(kind_of(function, name), value) for name, value in good.items()}
    drawn = {name: x for name, x in found.items() if x is not None}
    changes = st.fixed_dictionaries({}, optional=drawn)

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=EXAMPLES < 100,
        suppress_health_check=list(HealthCheck),
        database=None,
    )
    @given(changes)
    def check(values):
        values |= {k: mesh_of(*values[k]) for k in ("mesh", "cage") if k in values}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UserWarning)  # ours: negative weights and the like
            try:
                out = call(**{**good, **values})
                out = list(out) if isinstance(out, Iterator) else out
            except jd.InputError:
                return
            except eqx.EquinoxRuntimeError as error:
                if values.get("throw"):  # a Result, raised as it was asked for
                    return
                # One-off calls, which have no `throw`, raise theirs.
                if not any(words in str(error) for words in ("Not to be trusted", "Not finite")):
                    raise
                return
        assert not unsound(out)

    check()
