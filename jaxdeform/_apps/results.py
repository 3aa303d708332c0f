"""What the command line writes: meshes and reports."""

from pathlib import Path
from typing import Any

import numpy as np

import jaxdeform as jd
from jaxdeform._estimation.found_handles import FoundHandles
from jaxdeform._mesh.files import without_suffix

RESCUED = ".rescued.ply"


def save_result(
    out: Path, mesh: jd.Mesh, vertices: np.ndarray | None, rigidity: np.ndarray | None
) -> None:
    """Write the result, or beside it, as PLY, what its format cannot hold."""
    try:
        jd.save_mesh(out, mesh, vertices=vertices, rigidity=rigidity)
    except jd.InputError as error:
        rescue = rescue_of(out)
        try:
            jd.save_mesh(rescue, mesh, vertices=vertices, rigidity=rigidity)
        except jd.InputError:
            raise error from None
        raise jd.InputError(f"{error}; the result is in {rescue}") from error


def rescue_of(out: Path) -> Path:
    """Return the name of the file beside it that holds what its format cannot."""
    return out.with_name(f"{without_suffix(out).name}{RESCUED}")


def as_json(
    fit: jd.Estimate,
    handles: np.ndarray,
    found: FoundHandles | None = None,
    rings: list[int] | None = None,
) -> dict[str, Any]:
    """Return the content of the report. JSON has no infinity, so null stands for it.

    ``found`` says by which tolerance the handles were found, unless they were given; ``rings``
    are the sizes of the cells of each part, where they were estimated.
    """
    finite = lambda value: float(value) if np.isfinite(value) else None  # noqa: E731
    return {
        "parts": [
            {
                "rigidity": float(fit.rigidity[k]),
                "material": float(fit.material[k]),
                "interval": list(map(finite, fit.interval[k])),
                "verdict": fit.verdict[k].name,
                "displacement": list(map(finite, fit.displacement[k])),
            }
            for k in range(len(fit.rigidity))
        ],
        "misfit": finite(fit.misfit),
        "relative_misfit": finite(fit.relative_misfit),
        "solver_error": finite(fit.solver_error),
        "discrepancy": {
            name: finite(value) if isinstance(value, float) else value
            for name, value in fit.discrepancy._asdict().items()
        },
        "outliers": np.argwhere(fit.outliers).tolist(),
        "history": list(map(finite, fit.history)),
        "result": {"ok": fit.ok, "sentence": jd.Result[fit.result]},
        "handles": handles.tolist(),
        "found": {"tolerance": found.tolerance, "doubt": found.doubt} if found else None,
        "rings": rings,
    }
