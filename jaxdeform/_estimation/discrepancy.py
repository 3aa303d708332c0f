"""Does the model explain the poses? An exact F test of smooth patterns in the residual."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

# So many smooth patterns a pose are tried. Of 2,000 right draws on the bar one is rejected; a wrong
# neighbourhood size, two materials fitted as one, and a warp of 0.3 of the noise are all found.
_PATTERNS = 16
LEVEL = 1e-3
# A smooth part above this fraction of the diagonal is more than a wrong material.
_FOREIGN = 0.03


class Discrepancy(NamedTuple):
    """What the model leaves unexplained, beyond noise that is independent at every vertex.

    **Fields**

    - found: whether there is any, by an F test at the level 1e-3.
    - p_value: of that test.
    - size: root mean square of the smooth part of the residual (a length).
    - relative: the same as a fraction of the bounding box diagonal.
    - share: the same as a fraction of the difference between the softest and the stiffest material:
      a share of 0.1 hides a tenth of all that rigidity could do.
    - pose, vertex: where the smooth part is largest.
    """

    found: bool
    p_value: float
    size: float
    relative: float
    share: float
    pose: int
    vertex: int

    def explain(self) -> str:
        """Return it in words, with what to try next."""
        if not self.found:
            return "the model explains the poses: what it leaves is independent noise"
        share = f"{100 * self.share:.2g}" if self.share < 1 else f"{100 * self.share:,.0f}"
        text = (
            f"the model does not explain these poses: a smooth part of {self.size:.2g} is left "
            f"({100 * self.relative:.2g} % of the diagonal, {share} % of what "
            f"rigidity can do), the most at vertex {self.vertex} of pose {self.pose}. "
        )
        if self.relative > _FOREIGN:
            return f"{text}Are these poses of this mesh? Check unit, frame and order of vertices"
        return text + (
            "Try more parts or other regions, larger cells (estimate_rings), handles that moved as "
            "given, or solver=Alternating(steps) if a fixed number of steps made the poses"
        )


def f_test(
    jacobian: Float[np.ndarray, "poses vertices 3 parts"],
    residual: Float[np.ndarray, "poses vertices 3"],
    modes: Float[np.ndarray, "poses vertices modes"],
    count: int,
) -> float:
    """Return the p value of the smoothest patterns, as further unknowns beside the rigidities.

    ``count`` coordinates are compared. 1 where they are too few to say anything.
    """
    smooth = modes[..., :_PATTERNS]
    parts = jacobian.shape[-1]
    added = 3 * len(smooth) * smooth.shape[2]
    left = count - added - parts
    if not added or left < added:
        return 1.0
    columns = np.concatenate([jacobian, residual[..., None]], axis=-1)
    rough = columns - np.einsum(
        "pnk,pkca->pnca", smooth, np.einsum("pnk,pnca->pkca", smooth, columns)
    )
    before, after = (_least_cost(x.reshape(-1, parts + 1)) for x in (columns, rough))
    if not after > 0.0:
        return 1.0
    return float(special.fdtrc(added, left, (before - after) / added / (after / left)))


def _least_cost(columns: Float[np.ndarray, "coordinates columns"]) -> float:
    """Return the least |J x + r|^2, for columns J and r."""
    matrix, right = columns[:, :-1], columns[:, -1]
    # Columns without influence must not matter.
    matrix = matrix[:, np.any(matrix != 0.0, axis=0)]
    change, *_ = np.linalg.lstsq(matrix, right, rcond=1e-10)
    return float(np.sum((right - matrix @ change) ** 2))


def describe(
    residual: Float[np.ndarray, "poses vertices 3"],
    modes: Float[np.ndarray, "poses vertices modes"],
    count: int,
    p_value: float,
    diagonal: float,
    full_range: float,
) -> Discrepancy:
    """Return the discrepancy of a residual, given the p value of its test.

    ``full_range`` is the root mean square difference between softest and stiffest (a length).
    """
    along = np.einsum("pnk,pnc->pkc", modes, residual)
    smooth = np.einsum("pnk,pkc->pnc", modes, along) if modes.shape[2] else residual
    squares = float(np.sum(smooth**2))
    patterns = along.size
    if 0 < patterns < count:  # noise has a share in the patterns too
        squares -= patterns * (np.sum(residual**2) - np.sum(along**2)) / (count - patterns)
    size = float(np.sqrt(max(squares, 0.0) / count))
    pose, vertex = np.unravel_index(np.linalg.norm(smooth, axis=-1).argmax(), smooth.shape[:2])
    return Discrepancy(
        found=p_value < LEVEL,
        p_value=p_value,
        size=size,
        relative=size / diagonal,
        share=size / full_range if full_range > 0.0 else np.inf,
        pose=int(pose),
        vertex=int(vertex),
    )
