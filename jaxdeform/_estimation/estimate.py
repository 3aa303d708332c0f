"""The rigidity of parts as poses tell it, and what it means in words."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxdeform._estimation.discrepancy import Discrepancy
from jaxdeform._estimation.verdict import Verdict, in_words
from jaxdeform._result import Result, succeeded

# A vertex that moves less than this fraction of the diagonal does not move visibly.
_VISIBLE = 0.01


@dataclass(frozen=True, eq=False)
class Estimate:
    """Rigidity as observed poses tell it, with what they do not tell.

    **Fields**

    - rigidity: (parts,) best value of each part; its unit is length squared.
    - material: (parts,) the same as a scale-free constant (`rigidity_from_material`).
    - interval: (parts, 2) 95 % interval of the rigidity of each part. It starts at 0 where the part
      may be arbitrarily soft, and ends at infinity where it may be arbitrarily stiff.
    - verdict: a `Verdict` of each part, which follows from its interval.
    - displacement: (parts, 2) how far a compared vertex moves at most (a length) if the part
      becomes perfectly soft, or perfectly stiff. Where that is too little to see, the value hardly
      matters, however well it is known.
    - discrepancy: what the model leaves unexplained, a `Discrepancy`.
    - field: (vertices,) the rigidity of each vertex, as `deform` takes it.
    - vertices: (poses, vertices, 3) the fitted poses.
    - misfit: root mean square of the differences between fitted and observed coordinates (a
      length).
    - diagonal: of the bounding box of the rest shape; relative_misfit: misfit / diagonal.
    - solver_error: root mean square distance of the solver's end from the minimum (a length). The
      intervals allow for as much in the observed poses; a smaller misfit says nothing.
    - outliers: (poses, vertices) True where a vertex was left out, because it was seen far from
      where its neighbours say.
    - history: (evaluations,) misfit of each evaluation, accepted or not.
    - result: how the search ended, a member of `Result`.
    """

    rigidity: Float[np.ndarray, "parts"]
    material: Float[np.ndarray, "parts"]
    interval: Float[np.ndarray, "parts 2"]
    verdict: tuple[Verdict, ...]
    displacement: Float[np.ndarray, "parts 2"]
    discrepancy: Discrepancy
    field: Float[np.ndarray, "vertices"]
    vertices: Float[np.ndarray, "poses vertices 3"]
    misfit: float
    diagonal: float
    solver_error: float
    outliers: Bool[np.ndarray, "poses vertices"]
    history: Float[np.ndarray, "evaluations"]
    result: Result

    @property
    def ok(self) -> bool:
        """True if the search converged and the model explains the poses."""
        return bool(succeeded(self.result))

    @property
    def relative_misfit(self) -> float:
        """The misfit as a fraction of the diagonal."""
        return self.misfit / self.diagonal

    def explain(self) -> str:
        """Return everything in words, a line for each part and each fact."""
        lines = [self._explain_part(k) for k in range(len(self.rigidity))]
        lines.append(
            f"rigidity in squared mesh units; misfit {self.misfit:.3g} mesh units, "
            f"{100 * self.relative_misfit:.2g} % of the diagonal "
            f"({len(self.history)} evaluations)"
        )
        if self.misfit <= self.solver_error:
            lines.append(
                f"the misfit is within the error of the solver ({self.solver_error:.3g}): the "
                "poses are explained as well as its tolerance allows"
            )
        if self.outliers.any():
            at = np.argwhere(self.outliers)
            shown = ", ".join(f"{vertex} (pose {pose})" for pose, vertex in at[:3])
            lines.append(f"left out as seen in a wrong place: vertices {shown} ({len(at)} in all)")
        if self.history.min() < 0.95 * self.misfit:
            lines.append(
                "smooth errors count less, because noise of the handles causes them; by least "
                f"squares alone a misfit of {self.history.min():.3g} was reached"
            )
        if self.discrepancy.found:
            lines.append(self.discrepancy.explain())
        return "\n".join([*lines, Result[self.result]])

    def _explain_part(self, k: int) -> str:
        if self.result == Result.unsettled:
            return f"part {k}: {self.rigidity[k]:.4g}, without an interval"
        text = f"part {k}: {in_words(self.verdict[k], self.rigidity[k], self.interval[k])}"
        if self.discrepancy.found:
            text += " if the model were right"
        if self.verdict[k] is Verdict.determined:
            text += f", material {self.material[k]:.3g}"
        hidden = self.displacement[k] < _VISIBLE * self.diagonal
        kinds = [kind for kind, unseen in zip(("softer", "stiffer"), hidden, strict=True) if unseen]
        if kinds:
            text += (
                f"; {' or '.join(kinds)} makes no visible difference (less than "
                f"{100 * _VISIBLE:g} % of the diagonal at any vertex)"
            )
        return text
