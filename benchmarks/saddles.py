"""Does ``deform`` end at saddles? ``python -m benchmarks.saddles`` (2 minutes).

A bar, a tube and a plate are bent, twisted, pushed together and pulled, at five materials and with
rigid cells: 198 cases whose mesh, handles and targets are symmetric, so that a descent may stay
symmetric and end where the energy is not lowest. As a check, each end gets random noise and is
deformed once more. A row counts the cases, the ends from which the descent went on, the ends that
are said to be saddles, those that end lower after the noise, and those with cells inside out.
"""

from collections import Counter
from collections.abc import Iterator

import jax
import numpy as np

import jaxdeform as jd

MATERIALS = 1e-3, 1e-2, 0.1, 1.0, 100.0
NOISE = 1e-3
"""Standard deviation of a coordinate, as a fraction of the diagonal."""
STAYS = jd.QuasiNewton(leave_saddles=False)
VISIBLE = 1e-6
"""An end is lower if its energy is, by more than this fraction."""


def sheet(columns: int, rows: int, *, closed: bool) -> jd.Mesh:
    """Return a tube around the y axis, or a plate, of so many quads cut in two."""
    u, v = np.meshgrid(np.arange(columns + (not closed)), np.arange(rows + 1))
    if closed:
        angle = 2 * np.pi * u / columns
        radius = columns / (2 * np.pi)
        points = np.stack([radius * np.cos(angle), v, radius * np.sin(angle)], axis=-1)
    else:
        points = np.stack([u - columns / 2, v, 0 * u], axis=-1)
    count = points.shape[1]
    i, j = (x.ravel() for x in np.meshgrid(np.arange(columns), np.arange(rows)))
    corners = [(j + b) * count + (i + a) % count for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate(
        [np.stack([corners[k] for k in x], axis=1) for x in ([0, 1, 2], [0, 2, 3])]
    )
    return jd.Mesh(points.reshape(-1, 3).astype(float), faces)


def motions(rest: np.ndarray, length: float) -> Iterator[np.ndarray]:
    """Return what is done to the ends, all along y: bent, twisted, pushed and pulled."""
    for degrees in (45.0, 90.0, 120.0):
        yield np.asarray(jd.bend(rest, degrees))
    for degrees in (60.0, 120.0, 180.0):
        yield np.asarray(jd.twist(rest, degrees))
    upper = rest[:, 1] > rest[:, 1].mean()
    for share in (-0.05, -0.2, -0.4, 0.1, 0.3):
        yield rest + upper[:, None] * np.array([0.0, share * length, 0.0])


def count(mesh: jd.Mesh) -> Counter[str]:
    """Deform the mesh in all ways, and count how it ended."""
    handles = jd.select.where(mesh, "v < 0.06 or v > 0.94")
    problems: dict[jd.LocalStep, jd.Problem] = {jd.Newton(): jd.precompute(mesh, handles)}
    problems[jd.RotationFit()] = jd.precompute(mesh, handles, cells=jd.spokes(mesh))
    settings: list[tuple[jd.LocalStep, float]] = [(jd.RotationFit(), 0.0)]
    settings += [(jd.Newton(), material) for material in MATERIALS]
    random, found = np.random.default_rng(0), Counter()
    rest, length = mesh.vertices[handles.vertices], float(np.ptp(mesh.vertices[:, 1]))
    for targets in motions(rest, length):
        for local, material in settings:
            problem = problems[local]
            rigidity = jd.rigidity_from_material(problem, material)
            out = jd.deform(problem, targets, rigidity, local=local)
            before = jd.deform(problem, targets, rigidity, local=local, solver=STAYS)
            noise = NOISE * mesh.diagonal * random.standard_normal(mesh.vertices.shape)
            start = np.asarray(out.vertices) + noise
            after = jd.deform(problem, targets, rigidity, local=local, start=start)
            scale = 1.0 - VISIBLE
            found["cases"] += 1
            found["left"] += bool(out.energy[-1] < scale * before.energy[-1])
            found["said"] += bool(out.result == jd.Result.saddle)
            found["silent"] += bool(out.ok & (after.energy[-1] < scale * out.energy[-1]))
            found["flipped"] += bool(out.flipped > 0)
    return found


def main() -> None:
    """Print a row for each mesh."""
    meshes = {
        "bar": jd.shapes.bar(),
        "tube": sheet(24, 50, closed=True),
        "plate": sheet(16, 40, closed=False),
    }
    print("| mesh | cases | went on | saddles said | lower after noise | with flipped cells |")
    print("|---|---|---|---|---|---|")
    for name, mesh in meshes.items():
        found = count(mesh)
        columns = "cases", "left", "said", "silent", "flipped"
        print(f"| {name} | {' | '.join(str(found[x]) for x in columns)} |", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
