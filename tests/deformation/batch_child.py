"""What test_deform_batch.py runs in other processes: ``batch_child.py FILE [PORT PROCESS]``.

Writes the deformed vertices, the energies and the number of devices.
"""

import sys

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)
if __name__ == "__main__" and len(sys.argv) > 2:
    jax.distributed.initialize(f"localhost:{sys.argv[2]}", 2, int(sys.argv[3]))

import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402


def batch() -> tuple[jd.Problem, np.ndarray, np.ndarray]:
    """Return a bent plate, with 11 moves and rigidities, no multiple of any number of devices."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(7.0), np.arange(4.0)))
    corner = np.flatnonzero((x < 6) & (y < 3))
    halves = [corner, corner + 1, corner + 8], [corner, corner + 8, corner + 7]
    mesh = jd.Mesh(
        np.stack([x, y, 0.1 * x * y], 1), np.concatenate([np.stack(h, 1) for h in halves])
    )
    handles = np.flatnonzero((x == x.min()) | (x == x.max()))
    rest = mesh.vertices[handles]
    lift = np.outer(rest[:, 0] > x.mean(), [0.0, 0.0, 1.0]) * np.ptp(x)
    heights = np.linspace(0.0, 0.5, 11)
    problem = jd.precompute(mesh, handles)
    unit = float(np.mean(jd.rigidity_from_material(problem, 1.0)))
    return problem, rest + heights[:, None, None] * lift, unit * np.geomspace(0.05, 20.0, 11)


if __name__ == "__main__":
    problem, targets, rigidity = batch()
    out = jd.deform_batch(problem, targets, rigidity)
    found = {"vertices": out.vertices, "energy": out.energy[:, -1]}
    targets[2, 0] = np.nan
    try:
        jd.deform_batch(problem, targets, rigidity, throw=True)
    except eqx.EquinoxRuntimeError as error:
        found["raised"] = np.asarray(str(error))
    np.savez(sys.argv[1], devices=jax.device_count(), **found)
