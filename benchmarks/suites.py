"""The benchmarks themselves: each a function from ``quick`` to metrics, registered by name."""

import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxdeform as jd
from benchmarks import harness, workloads
from benchmarks.harness import Metric, child, interleaved
from benchmarks.thesis import ThesisDeformation
from benchmarks.workloads import Workload

SUITES: dict[str, Callable[[bool], list[Metric]]] = {}

# Histories of energy against time, for the pictures.
CURVES: dict[str, dict[str, tuple[list[float], list[float]]]] = {}

MATERIAL = 0.2
"""The scale-free material constant of workloads that name no rigidity."""


def suite(function):
    SUITES[function.__name__] = function
    return function


def reduced_energy(problem, vertices, targets, rigidity, local) -> float:
    """Evaluate every method's result by one functional: min over T of Eq. 4.4."""
    once = jd.Alternating(1)
    out = jd.deform(problem, targets, rigidity, local=local, start=vertices, solver=once)
    return float(out.energy[0])


# ---------------------------------------------------------------- one iteration


@suite
def iteration(quick: bool) -> list[Metric]:
    """One material iteration against one rigid iteration of libigl, and of Open3D."""
    loads = [workloads.cylinder()]
    if not quick:
        loads += [workloads.octopus(50_000), workloads.octopus(200_000)]
    out = []
    for load in loads:
        out += _iteration(load, steps=10 if load.mesh.n_vertices > 100_000 else 20)
    return out


def _iteration(load: Workload, steps: int) -> list[Metric]:
    data = load.libigl(steps)
    cells = jd.rings(load.mesh, 1)
    solver = jd.Alternating(steps)
    runs: dict[str, Callable[[], object]] = {"libigl": lambda: load.run_libigl(data, steps)}
    kept = []
    for kind in (np.float64, np.float32):
        problem = jd.precompute(load.mesh, load.handles, cells=cells, dtype=kind)
        rigidity = np.asarray(jd.material(problem, MATERIAL))
        start = load.start.astype(kind)
        kept.append(problem)
        # One evaluation more than steps, for the energy at the end.
        runs[kind.__name__] = lambda problem=problem, rigidity=rigidity, start=start: jd.deform(
            problem, load.targets, rigidity, solver=solver, start=start
        )
    open3d = _open3d(load, steps)
    if open3d is not None:
        runs["Open3D"] = open3d
    seconds = interleaved(runs, 3 if load.mesh.n_vertices > 100_000 else 5)
    per = {name: value / steps for name, value in seconds.items()}
    targets = {"float64": 1.0, "float32": 0.7}
    out = [
        Metric(
            f"material iteration / libigl's ARAP iteration, {kind}",
            load.name,
            per[kind] / per["libigl"],
            "1",
            target,
        )
        for kind, target in targets.items()
    ]
    if open3d is not None:
        label = "material iteration / Open3D's ARAP iteration, float64"
        ratio, note = per["float64"] / per["Open3D"], "its call factors anew"
        out.append(Metric(label, load.name, ratio, "1", note=note))
    for name, value in per.items():
        out.append(Metric(f"time per iteration, {name}", load.name, 1e3 * value, "ms"))
    return out


def _open3d(load: Workload, steps: int):
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    vector = open3d.utility
    mesh = open3d.geometry.TriangleMesh(
        vector.Vector3dVector(np.array(load.mesh.vertices)),  # it takes none that is read-only
        vector.Vector3iVector(load.mesh.faces.astype(np.int32)),
    )
    index = vector.IntVector(load.handles.astype(np.int32))
    points = vector.Vector3dVector(np.array(load.targets))
    return lambda: mesh.deform_as_rigid_as_possible(index, points, steps)


@suite
def cactus(quick: bool) -> list[Metric]:
    """The first thing a person tries: 100 iterations on the cactus, precomputation included."""
    load = workloads.cactus()
    load.start  # noqa: B018 (made before the clock starts, for both)

    def ours():
        problem = jd.precompute(load.mesh, load.handles)
        rigidity = jd.material(problem, MATERIAL)
        jd.deform(problem, load.targets, rigidity, solver=jd.Alternating(100), start=load.start)

    seconds = interleaved(
        {
            "libigl": lambda: load.run_libigl(load.libigl(100), 100),
            "ours": ours,
            "precompute": lambda: jd.precompute(load.mesh, load.handles),
            "libigl's": lambda: load.libigl(100),
        },
        3 if quick else 7,
    )
    ratio = seconds["ours"] / seconds["libigl"]
    name = "100 material iterations with precomputation / libigl's 100 rigid ones"
    return [
        Metric(name, load.name, ratio, "1", 1.0),
        Metric("precomputation", load.name, 1e3 * seconds["precompute"], "ms"),
        Metric("precomputation, libigl", load.name, 1e3 * seconds["libigl's"], "ms"),
    ]


# ---------------------------------------------------------------- to the minimum


@suite
def convergence(quick: bool) -> list[Metric]:
    """Time to come within 1e-4 of the minimum, the same functional evaluated for all."""
    loads = [workloads.bar()]
    if not quick:
        loads += [workloads.cylinder(), workloads.cactus()]
    out = []
    for load in loads:
        out += _convergence(load, repeats=3 if quick else 7)
    return out


def _convergence(load: Workload, repeats: int) -> list[Metric]:
    near = 1e-4
    rigid = jd.precompute(load.mesh, load.handles, cells=jd.spokes(load.mesh))
    fit = jd.RotationFit()
    peer_steps, peer_curve = _libigl_steps(load, rigid, fit, near)
    data = load.libigl(peer_steps)
    runs: dict[str, Callable[[], object]] = {"libigl": lambda: load.run_libigl(data, peer_steps)}
    curves = {"libigl ARAP, rigid": peer_curve}
    problem = jd.precompute(load.mesh, load.handles)
    cases = [("rigid limit", rigid, 0.0, fit, 0.4)]
    cases += [(f"rigidity {x:g}", problem, x, jd.Newton(), 0.8) for x in (1.0, 0.05)]
    for name, system, rigidity, local, _ in cases:
        steps, history = _our_steps(load, system, rigidity, local, near)
        solver = jd.QuasiNewton(max_steps=steps, tolerance=0.0)
        runs[name] = lambda system=system, rigidity=rigidity, local=local, solver=solver: jd.deform(
            system, load.targets, rigidity, local=local, solver=solver, start=load.start
        )
        curves[f"jaxdeform, {name}"] = (list(range(len(history))), history)
    seconds = interleaved(runs, repeats)
    for label, (steps, energy) in curves.items():
        name = label.split(", ")[1] if label.startswith("jax") else "libigl"
        per = seconds[name] / max(1, len(energy) - 1 if name != "libigl" else peer_steps)
        CURVES.setdefault(load.name, {})[label] = ([s * per for s in steps], energy)
    out = []
    for name, _, _, _, target in cases:
        label = f"time to within 1e-4 of the minimum, {name} / libigl's rigid ARAP"
        out.append(Metric(label, load.name, seconds[name] / seconds["libigl"], "1", target))
        out.append(Metric(f"time to within 1e-4, {name}", load.name, 1e3 * seconds[name], "ms"))
    out.append(
        Metric(
            "time to within 1e-4, libigl",
            load.name,
            1e3 * seconds["libigl"],
            "ms",
            note=f"{peer_steps} iterations",
        )
    )
    return out


def _our_steps(load, problem, rigidity, local, near: float) -> tuple[int, list[float]]:
    """Return the iterations that QuasiNewton needs, and the energies on the way over the least."""
    solver = jd.QuasiNewton(tolerance=1e-13, max_steps=3000)
    out = jd.deform(problem, load.targets, rigidity, local=local, solver=solver, start=load.start)
    energy = np.asarray(out.energy)[: int(out.steps) + 1]
    least = energy.min()
    steps = int(np.flatnonzero(energy <= least * (1 + near))[0])
    return steps, (energy[: steps + 1] / least - 1).tolist()


def _libigl_steps(load, problem, local, near: float) -> tuple[int, tuple[list, list]]:
    """Return libigl's iterations to the same nearness of the same minimum."""
    solver = jd.QuasiNewton(tolerance=1e-13, max_steps=3000)
    best = jd.deform(problem, load.targets, 0.0, local=local, solver=solver, start=load.start)
    least = float(best.energy[int(best.steps)])
    data = load.libigl(5)
    p, steps, energies = load.start, [0], []
    energies.append(reduced_energy(problem, p, load.targets, 0.0, local) / least - 1)
    while energies[-1] > near and steps[-1] < 5000:
        p = load.run_libigl(data, 5, start=p)
        steps.append(steps[-1] + 5)
        energies.append(reduced_energy(problem, p, load.targets, 0.0, local) / least - 1)
    return steps[-1], (steps, energies)


@suite
def thesis(quick: bool) -> list[Metric]:
    """The thesis's per-vertex gradient descent against ours, to the same energy."""
    loads = [(workloads.bar(), 1.0, 100)]
    if not quick:
        loads.append((workloads.cylinder(), 0.05, 8))
    out = []
    for load, rigidity, steps in loads:
        problem = jd.precompute(load.mesh, load.handles)
        theirs = ThesisDeformation(load.mesh, load.handles, jd.rings(load.mesh, 1))
        began = time.perf_counter()
        *_, p = theirs.iterate(load.targets, load.start, rigidity, steps)
        slow = time.perf_counter() - began
        reached = reduced_energy(problem, p, load.targets, rigidity, jd.Newton())
        ours = jd.deform(problem, load.targets, rigidity, start=load.start)
        energy = np.asarray(ours.energy)
        needed = int(np.flatnonzero(energy <= reached)[0])
        solver = jd.QuasiNewton(max_steps=max(1, needed), tolerance=0.0)
        runs = {
            "ours": lambda problem=problem, rigidity=rigidity, load=load, solver=solver: jd.deform(
                problem, load.targets, rigidity, solver=solver, start=load.start
            )
        }
        fast = interleaved(runs, 40)["ours"]  # a few ms each, and the first dozen find cold caches
        label = "thesis's way / ours, same energy reached"
        note = f"rigidity {rigidity:g}, its {steps} iterations"
        out += [
            Metric(label, load.name, slow / fast, "1", 1000, True, tolerance=0.4, note=note),
            Metric("time, the thesis's way", load.name, slow, "s"),
            Metric("time, ours to the same energy", load.name, 1e3 * fast, "ms"),
        ]
    return out


# ---------------------------------------------------------------- the local and the global step


@suite
def local_steps(quick: bool) -> list[Metric]:
    """The solvers of the local step on one set of cells: time and how far apart they end."""
    load = workloads.bar() if quick else workloads.cylinder()
    problem = jd.precompute(load.mesh, load.handles)
    rigidity = jd.material(problem, MATERIAL)
    c = problem.system.scatter(jnp.asarray(load.start.T))
    run = jax.jit(lambda c, b, lam, local: local.minimize(c, b, lam), static_argnames=("local",))
    solvers = [jd.Newton(), jd.LBFGS(), jd.GradientDescent(), jd.RotationFit(), jd.AffineFit()]
    runs = {
        type(local).__name__: lambda local=local: jax.block_until_ready(
            run(c, problem.system.b, rigidity, local)
        )
        for local in solvers
    }
    seconds = interleaved(runs, 3 if quick else 7)
    out = [Metric(f"local step, {k}", load.name, 1e3 * v, "ms") for k, v in seconds.items()]
    out.append(
        Metric("local step, Newton / LBFGS", load.name, seconds["Newton"] / seconds["LBFGS"], "1")
    )
    far = float(jnp.abs(runs["Newton"]() - runs["LBFGS"]()).max())
    out.append(Metric("largest difference in T, Newton and LBFGS", load.name, far, "", 1e-6))
    return out


@suite
def factors(quick: bool) -> list[Metric]:
    """What may solve the global step, by size, for one deformation and for 32 together.

    Dense and CHOLMOD cross where DENSE_BELOW says. Nested dissection is for accelerators; here it
    is timed on whatever JAX runs on.
    """
    import igl
    import scipy.sparse.linalg

    from jaxdeform import global_step
    from jaxdeform._linalg.nested_dissection import dissected_factor
    from jaxdeform.energy import stiffness
    from jaxdeform.global_step import factorise

    out, double = [], np.dtype(float)
    solve = jax.jit(lambda factor, b: factor.solve(b))
    for size in (1000, 5000) if quick else (500, 1000, 2000, 5000, 50_000, 200_000):
        load = workloads.tube(size)
        n = load.mesh.n_vertices
        matrix = stiffness(jd.rings(load.mesh, 1))
        free = np.ones(n, bool)
        free[load.handles] = False
        inner = matrix[free][:, free].tocsc()
        lu = scipy.sparse.linalg.splu(inner)
        peer = igl.min_quad_with_fixed_data()
        igl.min_quad_with_fixed_precompute(
            inner,
            np.zeros(0, np.int64),
            scipy.sparse.csc_matrix((0, inner.shape[0])),
            True,
            peer,
        )
        limit = global_step.DENSE_BELOW
        ours: dict[str, tuple[global_step.Factor, object]] = {
            "nested dissection": (
                dissected_factor(matrix, free, load.mesh.vertices, double),
                None,
            )
        }
        try:
            # Without positions, so that CHOLMOD is what it says also where there is an accelerator.
            for name, global_step.DENSE_BELOW in (("CHOLMOD", 0), ("dense inverse", 5200)):
                if name == "CHOLMOD" or n <= 5200:
                    ours[name] = factorise(matrix, free, double)
        finally:
            global_step.DENSE_BELOW = limit
        for lanes in (1, 32):
            right = np.random.default_rng(0).normal(size=(3 * lanes, n))
            right[:, ~free] = 0.0
            columns, b = jnp.asarray(right), np.ascontiguousarray(right[:, free].T)
            zeros = np.zeros((0, 3 * lanes))
            runs: dict[str, Callable[[], object]] = {
                name: lambda factor=factor, columns=columns: jax.block_until_ready(
                    solve(factor, columns)
                )
                for name, (factor, _) in ours.items()
            }
            runs["SuperLU through SciPy"] = lambda lu=lu, b=b: lu.solve(b)
            runs["libigl"] = lambda peer=peer, b=b, zeros=zeros: igl.min_quad_with_fixed_solve(
                peer, -b, zeros, zeros
            )
            far = [np.abs(np.asarray(run())).max() for run in runs.values()]
            assert np.ptp(far) < 1e-9 * max(far), "the solvers disagree"
            for name, value in interleaved(runs, 5).items():
                label = f"one solve of {3 * lanes} columns, {name}"
                out.append(Metric(label, load.name, 1e3 * value, "ms"))
    return out


# ---------------------------------------------------------------- living with it

_FIRST = """
import json, time
began = time.perf_counter()
import jax
jax.config.update("jax_enable_x64", True)
import jaxdeform as jd
mesh = jd.shapes.bar()
y = mesh.vertices[:, 1]
handles = ((y < 6) | (y > 145)).nonzero()[0]
problem = jd.precompute(mesh, handles)
jd.deform(problem, jd.bend(mesh.vertices[handles], 90.0), 1.0)
print(json.dumps(time.perf_counter() - began))
"""


@suite
def startup(quick: bool) -> list[Metric]:
    """Import and first deformation in a new process, with and without JAX's compilation cache."""
    import tempfile

    repeats = 1 if quick else 5
    first = sorted(child(_FIRST) for _ in range(repeats))[repeats // 2]
    with tempfile.TemporaryDirectory() as folder:
        settings = {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }
        child(_FIRST, environment=settings)
        later = sorted(child(_FIRST, environment=settings) for _ in range(repeats))[repeats // 2]
    name = "import and first deformation, new process"
    return [
        Metric(name, "bar", first, "s", 6.0),
        Metric(name + ", compilation cache on", "bar", later, "s", 3.0),
    ]


@suite
def dragging(quick: bool) -> list[Metric]:
    """A hand pulls an arm of the cactus: frames a second, and what other handles compile."""
    load = workloads.cactus()
    problem = jd.precompute(load.mesh, load.handles)
    rigidity = np.asarray(jd.material(problem, MATERIAL))
    solver = jd.QuasiNewton(max_steps=10, tolerance=1e-5)
    solution = jd.deform(problem, load.targets, rigidity, solver=solver, start=load.start)
    moving = load.targets - load.mesh.vertices[load.handles]
    frames = 20 if quick else 60
    path = [load.mesh.vertices[load.handles] + moving * (k + 1) / frames for k in range(frames)]
    worst, began = 0.0, time.perf_counter()
    for targets in path:
        frame = time.perf_counter()
        solution = jd.deform(problem, targets, rigidity, solver=solver, start=solution.vertices)
        worst = max(worst, time.perf_counter() - frame)
    mean = (time.perf_counter() - began) / frames

    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    for cut in (0.2, 0.4):
        y = load.mesh.vertices[:, 1]
        handles = np.flatnonzero((y < cut) | (y > 4.2))
        other = jd.precompute(load.mesh, handles)
        targets = load.mesh.vertices[handles] + 0.1
        jd.deform(other, targets, rigidity, solver=solver, start=load.start)
    return [
        Metric("frames a second while dragging", load.name, 1 / mean, "/s", 20, True),
        Metric("slowest frame", load.name, 1e3 * worst, "ms"),
        Metric("recompilations for new handle sets", load.name, len(compiled), "", 0),
    ]


@suite
def batch(quick: bool) -> list[Metric]:
    """64 rigidities of the bar under vmap, per lane, against one alone."""
    load = workloads.bar()
    problem = jd.precompute(load.mesh, load.handles)
    lanes = jnp.asarray(np.geomspace(0.05, 50.0, 64))
    out = []
    for solver in (jd.QuasiNewton(),) if quick else (jd.Alternating(100), jd.QuasiNewton()):
        one = jax.jit(
            lambda r, solver=solver: jd.deform(problem, load.targets, r, solver=solver).vertices
        )
        many = jax.jit(jax.vmap(one))
        seconds = interleaved(
            {
                "many": lambda many=many: jax.block_until_ready(many(lanes)),
                # Rigidities differ in their number of steps, so a single one is their mean.
                "one": lambda one=one: [jax.block_until_ready(one(r)) for r in lanes[::8]],
            },
            3 if quick else 15,
        )
        ratio = (seconds["many"] / 64) / (seconds["one"] / 8)
        name = f"batch of 64, {type(solver).__name__}, time per lane / single"
        out.append(Metric(name, load.name, ratio, "1", 0.7))
        out.append(Metric(f"deformations a second, batch of 64, {type(solver).__name__}",
                          load.name, 64 / seconds["many"], "/s", more_is_better=True))  # fmt: skip
    return out


# ---------------------------------------------------------------- size


@suite
def scaling(quick: bool) -> list[Metric]:
    """Time per iteration against the number of vertices."""
    sizes = (5_000, 20_000) if quick else (5_000, 20_000, 50_000, 200_000, 500_000)
    solver, counts, ours, theirs = jd.Alternating(5), [], [], []
    for size in sizes:
        load = workloads.tube(size)
        data = load.libigl(5)
        problem = jd.precompute(load.mesh, load.handles)
        rigidity = np.asarray(jd.material(problem, MATERIAL))
        start = load.mesh.vertices
        seconds = interleaved(
            {
                "ours": lambda problem=problem, load=load, rigidity=rigidity, start=start: (
                    jd.deform(problem, load.targets, rigidity, solver=solver, start=start)
                ),
                "libigl": lambda load=load, data=data, start=start: load.run_libigl(
                    data, 5, start=start
                ),
            },
            3,
        )
        counts.append(load.mesh.n_vertices)
        ours.append(seconds["ours"] / 5)
        theirs.append(seconds["libigl"] / 5)
    CURVES["size"] = {"jaxdeform, material": (counts, ours), "libigl, rigid": (counts, theirs)}
    exponent = float(np.polyfit(np.log(counts), np.log(ours), 1)[0])
    span = f"tube, {counts[0]:,} to {counts[-1]:,} vertices"
    return [
        Metric("exponent of time per iteration", span, exponent, "1", 1.15, tolerance=0.1),
        *(
            Metric("time per iteration", f"tube, {n:,} vertices", 1e3 * t, "ms")
            for n, t in zip(counts, ours, strict=True)
        ),
    ]


_MEMORY = """
import json, time
import jax
jax.config.update("jax_enable_x64", True)
import jaxdeform as jd
from benchmarks import workloads
load = workloads.{maker}({size})
began = time.perf_counter()
problem = jd.precompute(load.mesh, load.handles)
ready = time.perf_counter()
rigidity = jd.material(problem, 0.2)
out = jd.deform(problem, load.targets, rigidity, solver=jd.Alternating({steps}),
                start=load.mesh.vertices)
done = time.perf_counter()
assert bool(out.result.ok), str(out.result)
assert float(out.energy[-1]) < float(out.energy[0])
"""


_GRADIENT = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxdeform as jd
from benchmarks import workloads
load = workloads.tube(20_000)
problem = jd.precompute(load.mesh, load.handles)
base = jd.material(problem, 0.2)
solver, adjoint = jd.Alternating({steps}), jd.{adjoint}()
def loss(s):
    out = jd.deform(problem, load.targets, s * base, solver=solver, adjoint=adjoint,
                    start=load.mesh.vertices)
    return jnp.sum(out.vertices ** 2)
value, slope = jax.jit(jax.value_and_grad(loss))(1.0)
assert bool(jnp.isfinite(slope))
"""


@suite
def memory(quick: bool) -> list[Metric]:
    """Peak resident memory of a process that does one thing (Linux only)."""
    if sys.platform != "linux":
        return []
    jobs = [("tube", 50_000, 20, 2.0)] if quick else [
        ("octopus", 50_000, 100, 2.0),
        ("tube", 1_000_000, 20, 8.0),
    ]  # fmt: skip
    out = []
    for maker, size, steps, limit in jobs:
        code = _MEMORY.format(maker=maker, size=size, steps=steps) + harness.PEAK
        found = child(code + "print(json.dumps([ready - began, done - ready, peak_gib]))")
        name = f"{maker}, {size:,} vertices"
        out += [
            Metric(f"peak memory, precomputation and {steps} steps", name, found[2], "GiB", limit),
            Metric("precomputation", name, found[0], "s"),
            Metric(f"{steps} steps, compilation included", name, found[1], "s"),
        ]
    for adjoint, target in () if quick else (("Implicit", 1.05), ("Unrolled", None)):
        few, many = (
            child(_GRADIENT.format(steps=steps, adjoint=adjoint) + harness.PEAK + "print(peak_gib)")
            for steps in (50, 400)
        )
        name = f"peak memory of value and gradient, {adjoint}, 400 steps / 50 steps"
        out.append(Metric(name, "tube, 20,000 vertices", many / few, "1", target))
        out.append(Metric(f"peak memory, {adjoint}, 400 steps", "tube", many, "GiB"))
    return out


# ---------------------------------------------------------------- derivatives


@suite
def derivatives(quick: bool) -> list[Metric]:
    """Value and gradient against one deformation, for one unknown and for n."""
    load = workloads.bar() if quick else workloads.cylinder()
    problem = jd.precompute(load.mesh, load.handles)
    base = jd.material(problem, MATERIAL)
    observed = jd.deform(problem, load.targets, 2.0 * base, start=load.start).vertices
    out, number = [], jnp.asarray(1.0)
    cases = {
        "unrolled": (jd.Alternating(100), jd.Unrolled(), 4.0),
        "implicit": (jd.QuasiNewton(), jd.Implicit(), 2.5),
    }
    for kind, (solver, adjoint, target) in cases.items():

        def loss(rigidity, solver=solver, adjoint=adjoint):
            solution = jd.deform(
                problem, load.targets, rigidity, solver=solver, adjoint=adjoint, start=load.start
            )
            return jnp.sum((solution.vertices - observed) ** 2)

        plain, field = jax.jit(loss), jax.jit(jax.value_and_grad(loss))
        scalar = jax.jit(jax.value_and_grad(lambda s, loss=loss: loss(s * base)))
        runs: dict[str, Callable[[], object]] = {
            "value": lambda plain=plain: jax.block_until_ready(plain(base)),
            "1 unknown": lambda f=scalar, x=number: jax.block_until_ready(f(x)),
        }
        if not quick:
            runs["n unknowns"] = lambda field=field: jax.block_until_ready(field(base))
        seconds = interleaved(runs, 3 if quick else 5)
        value = seconds.pop("value")
        for unknowns, spent in seconds.items():
            ratio = spent / value
            name = f"value and gradient / one deformation, {kind}, {unknowns}"
            out.append(Metric(name, load.name, ratio, "1", target))
    return out
