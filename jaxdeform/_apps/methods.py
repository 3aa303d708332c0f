"""The methods that the apps offer: to each name its cells, its local step and its call."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxdeform as jd
from jaxdeform._apps.arguments import Material
from jaxdeform._errors import ArrayLike


class Method(StrEnum):
    """The methods, by their names on the command line and in a manifest."""

    material = "material"
    arap = "arap"
    rc_arap = "rc-arap"
    sr_arap = "sr-arap"
    laplacian = "laplacian"

    @property
    def has_rigidity(self) -> bool:
        """False where cells only rotate: they have no strain, and so no use for a rigidity."""
        return self == Method.material

    @property
    def has_energy(self) -> bool:
        """False where the shape is the solution of a linear system: nothing to iterate, or tell."""
        return self != Method.laplacian

    @property
    def has_spokes(self) -> bool:
        """Whether a cell is a vertex with its edges, of which there is one size."""
        return self in (Method.arap, Method.sr_arap)


class MethodSettings(NamedTuple):
    """How the vertices without a target follow: a method that has an energy, with its settings.

    What the method does not read is not looked at.
    """

    method: Method
    rings: int = 1
    alpha: float | None = None
    """None stands for the default of `sr_arap`."""
    steps: int | None = None
    """Number of alternating steps; None stands for convergence."""
    normals: bool = False

    def precompute(self, mesh: jd.Mesh, handles: ArrayLike) -> jd.Problem:
        """Factor the mesh with the cells of the method."""
        cells = jd.spokes(mesh) if self.method.has_spokes else jd.rings(mesh, self.rings)
        return jd.precompute(mesh, handles, cells=cells)

    def rigidity(self, material: Material, problem: jd.Problem) -> Float[np.ndarray, "vertices"]:
        """Return the rigidity of each vertex: zeros where the method has no use for it."""
        return material.at(problem) if self.method.has_rigidity else np.zeros(problem.n_vertices)

    def deform(
        self, problem: jd.Problem, targets: ArrayLike, rigidity: Float[np.ndarray, "vertices"]
    ) -> jd.Solution:
        """Deform once, as `jaxdeform.deform` does."""
        if self.method == Method.sr_arap:
            return self._smoothly(problem, targets, None)
        return jd.deform(problem, targets, rigidity, **self._options)

    def deform_path(
        self,
        problem: jd.Problem,
        path: Float[np.ndarray, "frames handles 3"],
        rigidity: Float[np.ndarray, "vertices"],
        progress: Callable[[int, int], Any] | None = None,
    ) -> jd.Solution:
        """Deform frame by frame, each from the one before, as `jaxdeform.deform_path` does."""
        if self.method != Method.sr_arap:
            return jd.deform_path(problem, path, rigidity, progress=progress, **self._options)
        frames: list[jd.Solution] = []
        for targets in path:
            last = frames[-1].vertices if frames else None
            frames.append(jax.block_until_ready(self._smoothly(problem, targets, last)))
            if progress is not None:
                progress(len(frames), len(path))
        return jax.tree.map(lambda *x: jnp.stack(x), *frames)

    @property
    def _options(self) -> dict[str, Any]:
        return {
            "local": jd.Newton() if self.method.has_rigidity else jd.RotationFit(),
            "solver": None if self.steps is None else jd.Alternating(self.steps),
            "normals": self.normals,
        }

    def _smoothly(self, problem: jd.Problem, targets, start) -> jd.Solution:
        """Call `sr_arap`, which finds the factor of this problem among those of the process."""
        own: dict[str, Any] = {} if self.alpha is None else {"alpha": self.alpha}
        mesh, handles = problem.mesh, problem.handles
        return jd.sr_arap(mesh, handles, targets, start=start, steps=self.steps, **own)
