"""Shared set-up: quick compilation, strict JAX, checked shapes, and the fixtures."""

import gc
import os
import platform
from importlib.metadata import version
from pathlib import Path

# Two thirds of the time of the tests is compilation. So LLVM does not optimise, has no wide
# instructions to think of, and gets no fusion emitters: a gradient of the bar compiles in 7 s of
# CPU (20 s with optimisation and wide instructions), runs half as fast, and agrees to rounding.
# What is compiled once is kept for the next run. (The demo, the benchmarks and whoever imports
# jaxdeform compile as JAX does by default.)
_QUICK = "--xla_backend_optimization_level=0"
if platform.machine() in ("x86_64", "AMD64"):
    _QUICK += " --xla_cpu_max_isa=SSE4_2"
if [int(part) for part in version("jaxlib").split(".")[:2]] < [0, 11]:
    # Later ones (0.11.2) have no such flag, and XLA ends a process that names an unknown one.
    _QUICK += " --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{_QUICK} {os.environ.get('XLA_FLAGS', '')}".strip()
_CACHE = Path(__file__).parents[1] / ".pytest_cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax
import numpy as np
import pytest
from jaxtyping import install_import_hook

# Tracing makes many objects that live on: collecting them each 700 takes a tenth of the time.
gc.set_threshold(50_000, 20, 50)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The annotations of every module are checked at every call (typechecker.py).
install_import_hook("jaxdeform", "typechecker.check")

from helpers import THESIS, ends, without_buckets

import jaxdeform as jd

# Minutes each: were they last, one of the two processes would wait for the other.
_LONGEST = [
    "test_notebooks.py",
    "test_docs_code.py",
    "test_batch_run.py",
    "test_house.py",
    "test_bucket.py",
    "test_parts.py",
    "test_coverage.py",
    "test_derivatives.py",
    "test_metric.py",
]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files."""
    place = {name: number for number, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Forget what was compiled once a process has many memory maps.

    Each program has three or more of them, without optimisation more. At 65,530 Linux refuses the
    next, and XLA ends the process: the slow tests reached that. A file adds up to 17,000.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 25_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def bar() -> jd.Mesh:
    return jd.shapes.bar()


@pytest.fixture(scope="session")
def bar_problem(bar: jd.Mesh) -> jd.Problem:
    return jd.precompute(bar, ends(bar))


@pytest.fixture(scope="session")
def bar_targets(bar: jd.Mesh, bar_problem: jd.Problem) -> np.ndarray:
    return np.asarray(jd.bend(bar.vertices[bar_problem.handles], 90.0))


@pytest.fixture(scope="module")
def exact_sizes():
    """Let arrays be as long as the mesh, without what fills them up to their bucket."""
    with pytest.MonkeyPatch.context() as patch:
        without_buckets(patch)
        yield


@pytest.fixture
def odd() -> jd.Mesh:
    """An open strip whose coordinates need all their bits."""
    v = np.random.default_rng(0).normal(size=(8, 3)) * [1e-7, 1.0, 1e7]
    return jd.Mesh(v, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6], [5, 7, 6]])


@pytest.fixture(scope="session")
def pose_of(bar_problem: jd.Problem, bar_targets: np.ndarray):
    """Return poses of the bent bar by rigidity, compiled once."""
    return lambda rigidity: np.asarray(
        jd.deform(bar_problem, bar_targets, rigidity, solver=THESIS).vertices
    )


@pytest.fixture(scope="session")
def equilibrium_of(bar_problem: jd.Problem, bar_targets: np.ndarray):
    """Return equilibria of the bent bar by rigidity, from another solver than the default."""
    to_the_end = jd.Alternating(steps=3000)
    return lambda rigidity: np.asarray(
        jd.deform(bar_problem, bar_targets, rigidity, solver=to_the_end).vertices
    )


@pytest.fixture(scope="session")
def halves(bar: jd.Mesh) -> np.ndarray:
    return (bar.vertices[:, 1] > 75).astype(int)
