"""A model of what a deformation costs: ``python -m benchmarks.cost_model``.

A model of few terms is fitted to measurements and checked on sizes that it was not fitted to. Each
measurement is a process of its own (children/cost.py), the least of three. Writes the tables of
docs/scaling.md.
"""

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from benchmarks.harness import run_child
from jaxdeform._linalg.buckets import bucket


class Size(NamedTuple):
    """What is deformed: vertices, rings of a cell, deformations at once."""

    vertices: int
    rings: int = 1
    members: int = 1


FITTED = (
    *(Size(n) for n in (1_000, 3_000, 9_000, 27_000, 80_000, 240_000)),
    *(Size(n, rings) for n in (3_000, 27_000) for rings in (2, 4)),
    *(Size(1_000, 1, members) for members in (4, 64)),
    *(Size(9_000, 1, members) for members in (4, 16)),
)
CHECKED = (
    Size(5_000), Size(50_000), Size(150_000), Size(10_000, 3), Size(5_000, 1, 8), Size(2_000, 1, 32)
)  # fmt: skip
KINDS = {"fitted": FITTED, "checked": CHECKED}

Row = Mapping[str, float]


def _work(row: Row) -> tuple[float, float, float]:
    """Return the vertices of the arrays, the entries of their cells, and the members."""
    n = bucket(int(row["vertices"]))
    return n, n * row["cell"], row["members"]


def _terms_of_precompute(row: Row) -> dict[str, float]:
    n, entries, _ = _work(row)
    return {"1": 1.0, "n": n, "n log n": n * np.log2(n), "n k^1.5": entries * row["cell"] ** 0.5}


def _terms_of_step(row: Row) -> dict[str, float]:
    n, entries, members = _work(row)
    return {
        "1": 1.0,
        "n l": n * members,
        "n l log n": n * members * np.log2(n),
        "n l k": entries * members,
    }


def _terms_of_peak(row: Row) -> dict[str, float]:
    n, entries, members = _work(row)
    return {"1": 1.0, "n": n, "n log n": n * np.log2(n), "n k": entries, "n l": n * members}


QUANTITIES: dict[str, Callable[[Row], dict[str, float]]] = {
    "precompute": _terms_of_precompute,
    "step": _terms_of_step,
    "peak": _terms_of_peak,
}
"""Seconds of `precompute`, seconds of a quasi-Newton step of all members, peak memory in GiB."""

Model = dict[str, dict[str, float]]


def fit(rows: list[Row]) -> Model:
    """Return the coefficient of each term of each quantity.

    None is negative, and relative errors count: a term that costs time on a small mesh does so on
    a large one, and no size outweighs the others.
    """
    model: Model = {}
    for name, terms in QUANTITIES.items():
        table = np.array([list(terms(row).values()) for row in rows])
        measured = np.array([row[name] for row in rows])
        scale = np.abs(table).max(axis=0)
        found, _ = nnls(table / scale / measured[:, None], np.ones(len(rows)))
        model[name] = dict(zip(terms(rows[0]), found / scale, strict=True))
    return model


def predict(model: Model, name: str, row: Row) -> float:
    """Return what the model says of a quantity."""
    terms = QUANTITIES[name](row)
    return sum(model[name][term] * value for term, value in terms.items())


def as_table(model: Model, rows: list[Row]) -> str:
    """Return measured values, and by how many per cent the model misses them."""
    lines = [
        "| vertices | k | members | precompute, s | model | step, ms | model | peak, GiB | model |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [f"{row['vertices']:,.0f}", f"{row['cell']:.1f}", f"{row['members']:.0f}"]
        for name, unit in (("precompute", 1.0), ("step", 1e3), ("peak", 1.0)):
            off = predict(model, name, row) / row[name] - 1
            cells += [f"{row[name] * unit:.3g}", f"{100 * off:+.0f} %"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, fit, check and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cost_model", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/cost_model.json"))
    options = parser.parse_args()
    rows = {kind: [run_child("cost", *size) for size in sizes] for kind, sizes in KINDS.items()}
    model = fit(rows["fitted"])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"model": model, **rows}, indent=1) + "\n")
    for kind in KINDS:
        print(f"{kind}:\n\n{as_table(model, rows[kind])}\n")
    for name, terms in model.items():
        print(f"{name}: " + " + ".join(f"{value:.3g} {term}" for term, value in terms.items()))


if __name__ == "__main__":
    main()
