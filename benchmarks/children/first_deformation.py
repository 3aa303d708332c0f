"""Print the seconds from nothing to the first deformation of the bar, imports included."""

import json
import time


def main() -> float:
    began = time.perf_counter()
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxdeform as jd

    mesh = jd.shapes.bar()
    y = mesh.vertices[:, 1]
    handles = ((y < 6) | (y > 145)).nonzero()[0]
    problem = jd.precompute(mesh, handles)
    jax.block_until_ready(jd.deform(problem, jd.bend(mesh.vertices[handles], 90.0), 1.0))
    return time.perf_counter() - began


if __name__ == "__main__":
    print(json.dumps(main()))
