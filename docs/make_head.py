"""Regenerate the film at the head of README.md: ``python docs/make_head.py``.

Needs the ``viewer`` extra. A cactus, soft below and stiff above, is pulled up and bent to both
sides.
"""

from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402

FRAMES = 40


def poses() -> tuple[jd.Mesh, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mesh, its handles, the constant of its material, and the poses of the film."""
    mesh = jd.shapes.cactus()
    top = jd.select.where(mesh, "v > 0.94")
    problem = jd.precompute(mesh, jd.select.where(mesh, "v < 0.05") | top, cells=jd.rings(mesh, 2))
    v = mesh.vertices[:, 1] / mesh.vertices[:, 1].max()
    constant = 10.0 ** np.interp(v, [0.22, 0.5], [-3, 1])
    rigidity = jd.rigidity_from_material(problem, constant)
    moved = top.mask[problem.handles]
    rest = mesh.vertices[problem.handles]
    center = np.array([0.0, 0.55 * mesh.vertices[:, 1].max(), 0.0])
    targets = np.repeat(rest[None], FRAMES, axis=0)
    for k, phase in enumerate(2 * np.pi * np.arange(FRAMES) / FRAMES):
        turned = jd.rotate(rest[moved], 65 * np.sin(phase), axis="z", center=center)
        targets[k, moved] = jd.translate(turned, [0.0, 0.7 * np.cos(phase) ** 2, 0.0])
    frames = jd.deform_path(problem, targets, rigidity).vertices
    return mesh, problem.handles, constant, np.asarray(frames)


if __name__ == "__main__":
    mesh, handles, constant, frames = poses()
    jd.animate(
        Path(__file__).parent / "head.gif",
        mesh,
        frames,
        values=constant,
        label="material",
        handles=handles,
        seconds=3.2,
        width=400,
    )
