"""Shared set-up: strict JAX, named tolerances, real meshes."""

from pathlib import Path

import jax
import numpy as np
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The annotations of the floors that take plain arrays are checked at every call. Not those of the
# public functions: they take whatever numpy can read (at run time no type says so), and misuse
# must reach their own checks.
install_import_hook(
    [
        f"jaxdeform.{name}"
        for name in (
            "_mesh.formats",
            "_mesh.laplacian",
            "energy",
            "_linalg.nested_dissection",
            "global_step",
        )
    ],
    "beartype.beartype",
)

import jaxdeform as jd  # noqa: E402 (after x64 and the hook)

EXACT = 1e-10
"""float64 algebra."""
PEER = 1e-6
"""libigl: its rotations are float32."""
FD = 1e-4
"""Central differences, relative."""

REAL = Path(__file__).parents[2] / "shared" / "meshes"


def real_mesh(name: str) -> jd.Mesh:
    """Return one of the real meshes, or skip where they are not at hand."""
    path = REAL / name
    if not path.exists():
        pytest.skip(f"{name} is not shipped with the project (needs {path.parent.name}/ beside it)")
    return jd.load_mesh(path)


def ends(mesh: jd.Mesh, part: float = 0.04, along: int = 1) -> np.ndarray:
    """Return the vertices at both ends along an axis, y if left out."""
    y = mesh.vertices[:, along]
    height = (y - y.min()) / np.ptp(y)
    return np.flatnonzero((height < part) | (height > 1 - part))


@pytest.fixture(scope="session")
def bar() -> jd.Mesh:
    return jd.shapes.bar()


@pytest.fixture(scope="session")
def bar_problem(bar: jd.Mesh) -> jd.Problem:
    return jd.precompute(bar, ends(bar))


@pytest.fixture(scope="session")
def bar_targets(bar: jd.Mesh, bar_problem: jd.Problem) -> np.ndarray:
    return np.asarray(jd.bend(bar.vertices[bar_problem.handles], 90.0))
