"""What test_processes.py runs in a process of its own: ``child.py TASK FILE [NUMBER]``.

Each task writes the deformed vertices, or an array of several, to the file.
"""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402

import jaxdeform as jd  # noqa: E402 (after x64)

STEPS = jd.Alternating(3)


def tube(size: int) -> jd.Mesh:
    """Return a tube of about ``size`` vertices, as wide as long."""
    around = int(np.sqrt(size))
    along = size // around
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + np.array([[0, y, 0]]) for y in np.linspace(0, 6, along)])
    k = np.arange(around)
    a, b = k, (k + 1) % around
    strip = np.concatenate(
        [np.stack([a, b, a + around], 1), np.stack([b, b + around, a + around], 1)]
    )
    return jd.Mesh(vertices, np.concatenate([strip + around * j for j in range(along - 1)]))


def problem(size: int = 1200, shift: int = 0) -> jd.Problem:
    mesh = tube(size)
    count = int(np.sqrt(size))
    return jd.precompute(
        mesh, np.r_[shift : count + shift, mesh.n_vertices - count : mesh.n_vertices]
    )


def deformed(given: jd.Problem, degrees: float = 60.0, solver=STEPS) -> jax.Array:
    """Return deformed vertices."""
    targets = jd.bend(given.vertices[np.asarray(given.handles)], degrees)
    return jd.deform(given, targets, 0.1, local=jd.RotationFit(), solver=solver).vertices


def here(file: Path) -> None:
    np.save(file, deformed(problem()))


def write(file: Path) -> None:
    made = problem()
    deformed(made).block_until_ready()
    (file.parent / "problem.pickle").write_bytes(pickle.dumps(made))
    eqx.tree_serialise_leaves(file.parent / "problem.eqx", made)
    np.save(file, deformed(made))


def unpickled(file: Path) -> None:
    deformed(problem(shift=50)).block_until_ready()  # a factor of another problem is there
    np.save(file, deformed(pickle.loads((file.parent / "problem.pickle").read_bytes())))


def leaves(file: Path) -> None:
    like = problem(shift=50)
    deformed(like).block_until_ready()
    np.save(file, deformed(eqx.tree_deserialise_leaves(file.parent / "problem.eqx", like)))


def cloudpickled(file: Path) -> None:
    import cloudpickle

    made = problem()
    function = cloudpickle.dumps(jax.tree_util.Partial(deformed, made))
    np.save(file, pickle.loads(function)())


def spawned(file: Path) -> None:
    made = problem()
    deformed(made).block_until_ready()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        np.save(file, pool.apply(_work, (made,)))


def forked(file: Path) -> None:
    """Fork after the import, before anything has run: JAX does not allow it later."""
    child = multiprocessing.get_context("fork").Process(target=here, args=(file,))
    child.start()
    child.join()


def _work(given: jd.Problem) -> np.ndarray:
    return np.asarray(deformed(given))


def threads(file: Path) -> None:
    """Eight threads deform one problem, then two threads each of four."""
    one = problem()
    several = [problem(shift=k) for k in range(4)]
    for problems in ([one] * 8, several * 2):
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(_work, problems))
        np.testing.assert_array_equal(found, [_work(p) for p in problems])
    np.save(file, found[0])


def devices(file: Path) -> None:
    """Deform on each of several devices at once."""
    made = problem()
    found = []
    for device in jax.devices():
        with jax.default_device(device):
            found.append(deformed(jax.device_put(made, device)))
    assert len(found) == 8
    assert {x.device for x in found} == set(jax.devices())
    np.save(file, np.stack(found)[7])


def hurried(file: Path) -> None:
    """End while deformations run, one of which has a result that nobody kept."""
    made = problem()
    np.save(file, deformed(made))
    handles = made.vertices[np.asarray(made.handles)]
    start = jax.jit(lambda targets: jd.deform(made, targets, 0.1, solver=jd.Alternating(300)))
    start(handles).vertices.block_until_ready()
    kept = [start(1.1 * handles), start(1.2 * handles)]
    del kept[0]
    sys.modules["kept"] = kept  # pyright: ignore[reportArgumentType]


def interrupted(file: Path, kind: int) -> None:
    """Press Ctrl-C while a deformation, an estimate or a path runs: it would take half an hour."""
    # Shells make background jobs deaf to it, and Python leaves that so.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    made = problem()
    pose = np.asarray(deformed(made))
    np.save(file, pose)

    def press() -> None:
        main = threading.main_thread().ident
        names: list[str] = []
        while "wait_for" not in names:
            time.sleep(0.01)
            frame, names = sys._current_frames()[main], []
            while frame is not None:
                names.append(frame.f_code.co_name)
                frame = frame.f_back
        time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press, daemon=True).start()
    endless = jd.Alternating(1_000_000)
    if kind == 1:
        deformed(made, solver=endless)
    if kind == 2:
        path = jd.bend(made.vertices[np.asarray(made.handles)], 60.0)[None]
        jd.deform_path(made, path, 0.1, solver=endless, progress=print)
    jd.estimate_rigidity(made, pose, solver=endless)


def sent_to_dask(file: Path) -> None:
    """Deform on a Dask worker: a process with a thread for the work."""
    from dask.distributed import Client, LocalCluster

    os.environ["JAX_ENABLE_X64"] = "1"  # the worker inherits it
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        np.save(file, client.submit(deformed, problem()).result())


def large(file: Path, size: int = 30_000, times: int = 1) -> None:
    """Deform a large mesh, several times."""
    made = problem(size)
    for k in range(times):
        out = np.asarray(deformed(made, 60.0 + k))
    np.save(file, out)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONWARNINGS", "error")
    globals()[sys.argv[1]](Path(sys.argv[2]), *map(int, sys.argv[3:]))
