"""Regenerate the figures and the table of docs/methods.md: ``python docs/make_methods.py``.

Needs the ``viewer`` extra. Figures are written beside this file; the tables replace those between
the marks in methods.md.
"""

import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402

HERE = Path(__file__).parent


# ---------------------------------------------------------------- the methods, on one mesh


def poses(mesh: jd.Mesh, kind: str) -> dict[str, np.ndarray]:
    """Every method on the same two ends: the lower one stays, the upper one moves rigidly."""
    y = mesh.vertices[:, 1]
    height = (y - y.min()) / np.ptp(y)
    handles = np.flatnonzero((height < 0.04) | (height > 0.96))
    maker = {"bend": lambda p: jd.bend(p, 90.0), "twist": lambda p: jd.twist(p, 135.0)}[kind]
    targets = np.asarray(maker(mesh.vertices[handles]))
    motion = rigid_motion(mesh.vertices[handles], targets, height[handles] > 0.5)
    moves = np.stack([np.eye(4)[:3], motion])
    ends = np.array([[0, y.min(), 0], [0, y.max(), 0]], float)
    weights = {
        "rigid": jd.rigid_weights(mesh.vertices, ends),
        "inverse": jd.inverse_distance_weights(mesh.vertices, ends),
        "biharmonic": jd.bounded_biharmonic_weights(
            mesh, handles, (height[handles] > 0.5).astype(int)
        ),
    }
    cage = box_cage(mesh)
    coordinates = jd.mean_value_coordinates(mesh.vertices, cage)
    out = {
        f"skinning, {name} weights": jd.linear_blend_skinning(mesh.vertices, w, moves)
        for name, w in weights.items()
    }
    out["dual quaternions, biharmonic"] = jd.dual_quaternion_skinning(
        mesh.vertices, weights["biharmonic"], moves
    )
    out["cage, mean values"] = coordinates @ moved_cage(cage, motion)
    out["Laplacian editing"] = jd.laplacian_editing(mesh, handles, targets)
    out["Laplacian, similarity"] = jd.laplacian_editing(mesh, handles, targets, similarity=True)
    for name, cells in (("ARAP", jd.spokes(mesh)), ("RC-ARAP, r = 2", jd.rings(mesh, 2))):
        problem = jd.precompute(mesh, handles, cells=cells)
        out[name] = jd.deform(problem, targets, 0.0, local=jd.RotationFit()).vertices
    problem = jd.precompute(mesh, handles)
    for constant in (0.01, 100.0):
        out[f"ours, λ = {constant:g}"] = jd.deform(problem, targets, constant).vertices
    mixed = np.where(height < 0.5, 0.01, 100.0)
    out["ours, λ mixed"] = jd.deform(problem, targets, mixed).vertices
    return {name: np.asarray(pose) for name, pose in out.items()}


def rigid_motion(points, targets, upper):
    """The (3, 4) matrix of the upper end's motion."""
    a, b = points[upper], targets[upper]
    u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    turn = (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T
    return np.concatenate([turn, (b.mean(0) - turn @ a.mean(0))[:, None]], axis=1)


def box_cage(mesh: jd.Mesh) -> jd.Mesh:
    """Three boxes on each other around the mesh: sixteen corners."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    margin = 0.05 * np.ptp(mesh.vertices, axis=0).max()
    levels = [low[1] - margin, *np.linspace(low[1], high[1], 4)[1:3], high[1] + margin]
    side = [(low[0], low[2]), (low[0], high[2]), (high[0], high[2]), (high[0], low[2])]
    widen = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)]) * margin
    corners = [
        [x + dx, y, z + dz] for y in levels for (x, z), (dx, dz) in zip(side, widen, strict=True)
    ]
    faces = [(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)]
    for level in range(3):
        for k in range(4):
            a, b = 4 * level + k, 4 * level + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    return jd.Mesh(corners, faces)


def moved_cage(cage: jd.Mesh, motion) -> np.ndarray:
    """The upper half of the corners goes with the upper end, the lower half stays."""
    corners = cage.vertices.copy()
    corners[8:] = corners[8:] @ motion[:, :3].T + motion[:, 3]
    return corners


# ---------------------------------------------------------------- pictures


def bar_pictures() -> None:
    """The same bend and the same twist by every method (thesis Fig. 5.1)."""
    mesh = jd.shapes.bar()
    y = mesh.vertices[:, 1]
    halves = np.where(y < y.mean(), 0.01, 100.0)
    for kind in ("bend", "twist"):
        shown = poses(mesh, kind)
        jd.render(
            HERE / f"methods-{kind}.png",
            mesh,
            list(shown.values()),
            titles=list(shown),
            values=[halves if name.endswith("mixed") else None for name in shown],
            columns=6,
            edges=True,
            width=260,
        )


def cactus_case():
    """Thesis Fig. 5.5: foot held, top bent; the middle stiff (r = 2), the rest soft (r = 1)."""
    mesh = jd.shapes.cactus()
    x, y, _ = mesh.vertices.T
    handles = np.flatnonzero((y < 0.3) | (y > 4.3))
    targets = np.asarray(jd.bend(mesh.vertices[handles], 50.0))
    trunk = (np.abs(x) < 0.75) & (y > 1.3) & (y < 2.7)
    return mesh, handles, targets, trunk


def cactus_picture() -> None:
    """Laplacian editing against ours, r and λ mixed (thesis Fig. 5.5)."""
    mesh, handles, targets, trunk = cactus_case()
    cells = jd.rings(mesh, np.where(trunk, 2, 1))
    problem = jd.precompute(mesh, handles, cells=cells)
    rigidity = np.where(trunk, 50.0, 0.01)
    arap = jd.precompute(mesh, handles, cells=jd.spokes(mesh))
    shown = {
        "rest": (mesh.vertices, None),
        "blue: r = 2, λ = 50": (mesh.vertices, rigidity),
        "Laplacian editing": (jd.laplacian_editing(mesh, handles, targets), None),
        "ARAP": (jd.deform(arap, targets, 0.0, local=jd.RotationFit()).vertices, None),
        "ours, r and λ mixed": (jd.deform(problem, targets, rigidity).vertices, rigidity),
    }
    jd.render(
        HERE / "methods-cactus.png",
        mesh,
        [pose for pose, _ in shown.values()],
        titles=list(shown),
        values=[values for _, values in shown.values()],
        handles=handles,
        width=280,
    )


# ---------------------------------------------------------------- tables


def seconds(run, repeats: int = 20) -> float:
    """Fastest of some runs after a first one, which compiles: others use the machine as well."""
    jax.block_until_ready(run())
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        taken.append(time.perf_counter() - began)
    return min(taken)


def timing_rows() -> str:
    """Once per mesh, and per frame, on the cactus."""
    mesh, handles, targets, trunk = cactus_case()
    y = mesh.vertices[handles, 1]
    group = (y > y.mean()).astype(int)
    motion = rigid_motion(mesh.vertices[handles], targets, group == 1)
    moves = jax.numpy.asarray(np.stack([np.eye(4)[:3], motion]))
    ends = np.stack([mesh.vertices[handles][group == g].mean(axis=0) for g in (0, 1)])
    cage = box_cage(mesh)
    corners = moved_cage(cage, motion)

    def once(make):
        jax.block_until_ready(make())  # compiles
        began = time.perf_counter()
        made = jax.block_until_ready(make())
        return time.perf_counter() - began, made

    rows = []

    def row(name, make, frame):
        before, made = once(make)
        rows.append(f"| {name} | {show(before)} | {show(seconds(lambda: frame(made)))} |")

    for kind, make in {
        "inverse distance": lambda: jd.inverse_distance_weights(mesh.vertices, ends),
        "geodesic inverse distance": lambda: jd.inverse_distance_weights(
            mesh.vertices, ends, distances=jd.geodesic_distances(mesh, handles[[0, -1]])
        ),
        "bounded biharmonic": lambda: jd.bounded_biharmonic_weights(mesh, handles, group),
    }.items():
        blend = jax.jit(jd.linear_blend_skinning)
        row(f"linear blend skinning, {kind}", make, lambda w, f=blend: f(mesh.vertices, w, moves))
    blend = jax.jit(jd.dual_quaternion_skinning)
    row(
        "dual quaternion skinning, inverse distance",
        lambda: jd.inverse_distance_weights(mesh.vertices, ends),
        lambda w: blend(mesh.vertices, w, moves),
    )
    row(
        "cage, mean value coordinates",
        lambda: jd.mean_value_coordinates(mesh.vertices, cage),
        lambda w: w @ corners,
    )
    row("Laplacian editing", lambda: jd.laplacian_editor(mesh, handles), lambda e: e(targets))
    row(
        "Laplacian editing, similarity",
        lambda: jd.laplacian_editor(mesh, handles, similarity=True),
        lambda e: e(targets),
    )
    mixed = np.where(trunk, 50.0, 0.01)
    for name, cells, rigidity, local in (
        ("ARAP", lambda: jd.spokes(mesh), 0.0, jd.RotationFit()),
        ("RC-ARAP, r = 2", lambda: jd.rings(mesh, 2), 0.0, jd.RotationFit()),
        ("ours, λ and r mixed", lambda: jd.rings(mesh, np.where(trunk, 2, 1)), mixed, jd.Newton()),
    ):
        before, problem = once(lambda c=cells: jd.precompute(mesh, handles, cells=c()))
        solve = lambda p, lam=rigidity, how=local: jd.deform(p, targets, lam, local=how)  # noqa: E731
        steps = int(solve(problem).steps)
        whole = seconds(lambda: solve(problem), 7)  # noqa: B023 (run at once)
        rows.append(
            f"| {name} | {show(before)} | {show(whole)} ({steps} steps of {show(whole / steps)}) |"
        )
    return "\n".join(["| method | once | per frame |", "|---|---|---|", *rows])


def show(t: float) -> str:
    """Two digits of a time."""
    return f"{t:.1f} s" if t >= 1 else f"{1000 * t:.2g} ms" if t < 0.1 else f"{1000 * t:.0f} ms"


def rate_rows() -> str:
    """How far the shape is from ARAP's on the same cells, as rigidity grows (the bent bar)."""
    mesh = jd.shapes.bar()
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 6) | (y > 145))
    targets = jd.bend(mesh.vertices[handles], 90.0)
    problem = jd.precompute(mesh, handles)
    solver = jd.Alternating(steps=100)
    rigid = jd.deform(problem, targets, 0.0, local=jd.RotationFit(), solver=solver).vertices
    rows, last = ["| λ | largest distance / height of the bar | ratio |", "|---|---|---|"], None
    for power in range(1, 8):
        out = jd.deform(problem, targets, 10.0**power, solver=solver).vertices
        gap = float(np.abs(out - rigid).max() / 151)
        rows.append(f"| 1e{power} | {gap:.2e} | {'' if last is None else f'{last / gap:.1f}'} |")
        last = gap
    return "\n".join(rows)


def replace_table(mark: str, table: str) -> None:
    """Put a table between its two marks in methods.md."""
    path = HERE / "methods.md"
    text = path.read_text(encoding="utf-8")
    begin, end = f"<!-- {mark} -->\n", f"<!-- end {mark} -->"
    head, rest = text.split(begin)
    path.write_text(head + begin + table + "\n" + end + rest.split(end)[1], encoding="utf-8")


if __name__ == "__main__":
    bar_pictures()
    cactus_picture()
    replace_table("rate", rate_rows())
    replace_table("timing", timing_rows())
