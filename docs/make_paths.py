"""Regenerate the figure of docs/paths.md: ``python docs/make_paths.py``.

Needs the ``viewer`` extra. The figure is written beside this file.
"""

from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxdeform as jd  # noqa: E402


def turn_picture() -> None:
    """The bar turned once: at once and by a path, of stiff and of medium material."""
    mesh = jd.shapes.bar()
    y = mesh.vertices[:, 1]
    handles = np.flatnonzero((y < 6) | (y > 145))
    problem = jd.precompute(mesh, handles)
    targets = [jd.twist(mesh.vertices[handles], 10.0 * k) for k in range(1, 37)]
    shown = {}
    for name, constant in (("stiff", 10.0), ("medium", 0.2)):
        rigidity = jd.rigidity_from_material(problem, constant)
        path = jd.deform_path(problem, targets, rigidity)
        if not shown:
            at_once = jd.deform(problem, targets[-1], rigidity)
            shown["deform, 360°"] = np.asarray(at_once.vertices)
        for degrees in (90, 180, 270, 360):
            if name == "stiff" or degrees > 180:
                shown[f"{name}, path, {degrees}°"] = np.asarray(path.vertices[degrees // 10 - 1])
    jd.render(
        Path(__file__).parent / "paths-turn.png",
        mesh,
        list(shown.values()),
        titles=list(shown),
        columns=len(shown),
        edges=True,
        width=220,
    )


if __name__ == "__main__":
    turn_picture()
