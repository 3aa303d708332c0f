"""Regenerate the figures and the table of docs/methods.md: ``python docs/make_methods.py``.

Needs the ``viewer`` extra. Figures are written beside this file; the tables replace those between
the marks in methods.md.
"""

import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import pyvista  # noqa: E402
from PIL import Image  # noqa: E402

import jaxdeform as jd  # noqa: E402

HERE = Path(__file__).parent
SOFT, STIFF = "#e8a33d", "#3d7fb8"


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
        out[f"ours, lambda = {constant:g}"] = jd.deform(problem, targets, constant).vertices
    mixed = np.where(height < 0.5, 0.01, 100.0)
    out["ours, lambda mixed"] = jd.deform(problem, targets, mixed).vertices
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


def sheet(path: Path, mesh: jd.Mesh, shown: dict[str, np.ndarray], columns: int, **look) -> None:
    """Draw poses in a grid, all to one scale and from one side."""
    rows = -(-len(shown) // columns)
    size, height = look.get("size", 230), look.get("height", 230)
    plotter = pyvista.Plotter(
        shape=(rows, columns), window_size=[size * columns, height * rows], off_screen=True,
        border=False,
    )  # fmt: skip
    together = np.concatenate(list(shown.values()))
    middle = (together.min(axis=0) + together.max(axis=0)) / 2
    for k, (name, pose) in enumerate(shown.items()):
        plotter.subplot(k // columns, k % columns)
        surface = pyvista.PolyData.from_regular_faces(pose, mesh.faces)
        colour = look.get("colours", {}).get(name, "lightsteelblue")
        kind = {"color": colour} if isinstance(colour, str) else {"scalars": colour, "rgb": True}
        plotter.add_mesh(
            surface,
            show_edges=look.get("edges", True),
            edge_color="slategray",
            line_width=0.1,
            ambient=0.3,
            **kind,
        )
        plotter.add_text(name, position=(6, height - 18), font_size=7, color="black")
        plotter.camera_position = [middle + look["eye"], middle, (0, 1, 0)]
        plotter.camera.parallel_projection = True
        plotter.camera.parallel_scale = look.get("zoom", 0.58) * np.ptp(together, axis=0).max()
        plotter.renderer.ResetCameraClippingRange()
    plotter.set_background("white")
    image = plotter.screenshot(return_img=True)
    plotter.close()
    # 128 colours: a third of the bytes, and hardly a difference to the eye.
    few = Image.fromarray(image).quantize(128, method=Image.Quantize.FASTOCTREE)
    few.save(path, optimize=True)


def bar_pictures() -> None:
    """The same bend and the same twist by every method (thesis Fig. 5.1)."""
    mesh = jd.shapes.bar()
    far = 1000 * np.array([0.35, 0.25, 1.0])
    for kind in ("bend", "twist"):
        shown = poses(mesh, kind)
        y = mesh.vertices[:, 1]
        halves = np.where((y < y.mean())[:, None], rgb(SOFT), rgb(STIFF))
        sheet(
            HERE / f"methods-{kind}.png",
            mesh,
            shown,
            6,
            eye=far,
            colours={"ours, lambda mixed": halves},
        )


def rgb(colour: str) -> np.ndarray:
    """Three bytes."""
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], np.uint8)


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
    held = np.isin(np.arange(mesh.n_vertices), handles)
    cells = jd.rings(mesh, np.where(trunk, 2, 1))
    problem = jd.precompute(mesh, handles, cells=cells)
    rigidity = np.where(trunk, 50.0, 0.01)
    paint = np.where(trunk[:, None], rgb(STIFF), rgb(SOFT))
    shown = {
        "rest, handles dark": mesh.vertices,
        "blue: r = 2, lambda = 50": mesh.vertices,
        "Laplacian editing": jd.laplacian_editing(mesh, handles, targets),
        "ARAP": jd.deform(
            jd.precompute(mesh, handles, cells=jd.spokes(mesh)),
            targets,
            0.0,
            local=jd.RotationFit(),
        ).vertices,
        "ours, r and lambda mixed": jd.deform(problem, targets, rigidity).vertices,
    }
    sheet(
        HERE / "methods-cactus.png",
        mesh,
        {name: np.asarray(pose) for name, pose in shown.items()},
        5,
        eye=100 * np.array([0.25, 0.15, 1.0]),
        edges=False,
        size=280,
        height=310,
        zoom=0.56,
        colours={
            "rest, handles dark": np.where(held[:, None], rgb("#40305a"), rgb("#c8d4e6")),
            "blue: r = 2, lambda = 50": paint,
            "ours, r and lambda mixed": paint,
        },
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
