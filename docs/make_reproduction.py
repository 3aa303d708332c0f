"""Regenerate the tables of docs/reproduction.md: ``python docs/make_reproduction.py``.

What the notebooks do not show: the overlap of cells, and what 100 steps of the thesis's iteration
leave. The tables replace those between the marks in reproduction.md.
"""

from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402

PAGE = Path(__file__).parent / "reproduction.md"
HUNDRED = jd.Alternating(steps=100)


def from_rubber_to_arap() -> str:
    """Fig. 5.1: the distance to ARAP, after 100 steps and at the minimum."""
    mesh = jd.shapes.bar()
    handles = jd.select.where(mesh, "y < 6 or y > 145")
    problem = jd.precompute(mesh, handles)
    targets = jd.bend(mesh.vertices[problem.handles], 90.0)
    spokes = jd.precompute(mesh, handles, cells=jd.spokes(mesh))
    rows = [
        "| λ | 100 steps: energy | from ARAP | the minimum: energy | from ARAP |",
        "|" + "---|" * 5,
    ]
    local = jd.RotationFit()
    arap = [
        jd.deform(spokes, targets, 0.0, local=local, solver=s).vertices
        for s in (HUNDRED, jd.QuasiNewton())
    ]
    for rigidity in (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0):
        cells = []
        for solver, rigid in zip((HUNDRED, jd.QuasiNewton()), arap, strict=True):
            out = jd.deform(problem, targets, rigidity, solver=solver)
            gap = float(np.abs(out.vertices - rigid).max() / 151)
            cells.append(f"{float(out.energy[-1]):.1f} | {gap:.1%}")
        rows.append(f"| {rigidity:g} | {' | '.join(cells)} |")
    return "\n".join(rows)


def overlap() -> str:
    """Fig. 3.3: how much of its edges a cell shares with that of a neighbour."""
    mesh = jd.shapes.bar()
    i, j = mesh.edges.T
    rows = ["| r | edges of a cell | shared with a neighbour's |", "|---|---|---|"]
    for r in (1, 2, 3):
        member = jd.rings(mesh, r).membership.astype(float)
        size = np.asarray(member.sum(axis=1)).ravel()
        shared = np.asarray(member[i].multiply(member[j]).sum(axis=1)).ravel()
        rows.append(f"| {r} | {size.mean():.0f} | {(shared / size[i]).mean():.0%} |")
    return "\n".join(rows)


def replace_table(mark: str, table: str) -> None:
    """Put a table between its two marks."""
    text = PAGE.read_text(encoding="utf-8")
    begin, end = f"<!-- {mark} -->\n", f"<!-- end {mark} -->"
    head, rest = text.split(begin)
    PAGE.write_text(head + begin + table + "\n" + end + rest.split(end)[1], encoding="utf-8")


if __name__ == "__main__":
    replace_table("overlap", overlap())
    replace_table("arap", from_rubber_to_arap())
