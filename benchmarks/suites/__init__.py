"""The suites by name, in the order in which they run. Each takes ``quick``, returns Findings."""

from collections.abc import Callable

from benchmarks.metrics import Findings
from benchmarks.suites import (
    accelerator,
    batch,
    cactus,
    cgal,
    convergence,
    derivatives,
    dragging,
    factors,
    iteration,
    local_steps,
    memory,
    meshes,
    runs,
    scaling,
    softness,
    startup,
    thesis,
)

SUITES: dict[str, Callable[[bool], Findings]] = {
    "iteration": iteration.run,
    "cactus": cactus.run,
    "convergence": convergence.run,
    "cgal": cgal.run,
    "softness": softness.run,
    "thesis": thesis.run,
    "local_steps": local_steps.run,
    "factors": factors.run,
    "startup": startup.run,
    "meshes": meshes.run,
    "dragging": dragging.run,
    "batch": batch.run,
    "runs": runs.run,
    "scaling": scaling.run,
    "memory": memory.run,
    "derivatives": derivatives.run,
    "accelerator": accelerator.run,
}
