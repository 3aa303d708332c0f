"""One job: read, deform or fit. What it needs is named by the job, so any process can do it."""

import time
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import jaxdeform as jd
from jaxdeform._apps.arguments import read_material, read_pose
from jaxdeform._apps.batch.job import Job, digest_of
from jaxdeform._apps.methods import Method, MethodSettings
from jaxdeform._apps.moves import Motion, Moves, moves_by_place, moves_of_file
from jaxdeform._mesh.select import some_where
from jaxdeform._result import name_of


class Done(NamedTuple):
    """What came of a job."""

    vertices: Float[np.ndarray, "vertices 3"]
    """The last frame; of a fit, the poses are the input, and these are NaN."""
    rigidity: Float[np.ndarray, "vertices"]
    """What it was deformed with, or the estimate."""
    energy: float
    misfit: float
    """Of a fit, in the unit of the mesh."""
    steps: int
    flipped: int
    result: str
    """The name of a member of `Result`."""
    seconds: float


def do(job: Job) -> Done:
    """Do a job. **Raises** whatever is wrong with it."""
    began = time.perf_counter()
    mesh, moves, problem = _prepared(job)
    done = _fit(job, mesh, problem) if job.poses else _deform(job, mesh, moves, problem)
    return done._replace(seconds=time.perf_counter() - began)


# A worker may outlive a run, and the next run may find other content under the same names.
@lru_cache(maxsize=4)
def _mesh(path: str, digest: str) -> jd.Mesh:
    return jd.load_mesh(path)


# The last problem, which the next job mostly shares.
_kept: list[Any] = []


def _prepared(job: Job) -> tuple[jd.Mesh, Moves | None, jd.Problem]:
    """Return the mesh, the moves of this job, and the problem, which the last job may have left."""
    digests = [digest_of(name) for name in job.files_of_problem]
    key = job.problem, digests
    mesh = _mesh(job.mesh, digests[0])
    if job.handles:
        moves = moves_of_file(mesh, Path(job.handles), None)
        handles = moves.handles
    elif job.poses:
        named = {"fix": job.fix, "move": job.move}
        chosen = [some_where(mesh, x, name) for name, x in named.items() if x]
        moves, handles = None, np.unique(np.concatenate([x.vertices for x in chosen]))
    else:
        motion = Motion(job.rotate, job.about, job.translate)  # pyright: ignore[reportArgumentType]
        moves = moves_by_place(mesh, [job.fix] if job.fix else [], job.move, motion)
        handles = moves.handles
    if not _kept or _kept[0] != key:
        _kept[:] = key, _settings(job).precompute(mesh, handles)
    return mesh, moves, _kept[1]


def _settings(job: Job) -> MethodSettings:
    return MethodSettings(Method(job.method), job.rings, job.alpha)


def _deform(job: Job, mesh: jd.Mesh, moves: Moves | None, problem: jd.Problem) -> Done:
    assert moves is not None
    settings = _settings(job)
    rigidity = settings.rigidity(read_material(mesh, job.rigidity, list(job.stiff)), problem)
    if job.frames is None:
        out = settings.deform(problem, moves.targets, rigidity)
    else:
        path = settings.deform_path(problem, moves.path(job.frames), rigidity)
        out = jax.tree.map(lambda x: x[-1], path)
    return Done(
        np.asarray(out.vertices),
        rigidity,
        float(out.energy[-1]),
        np.nan,
        int(out.steps),
        int(out.flipped),
        name_of(out.result),
        0.0,
    )


def _fit(job: Job, mesh: jd.Mesh, problem: jd.Problem) -> Done:
    rest = Path(job.mesh)
    poses = np.stack([read_pose(Path(pose), mesh, rest) for pose in job.poses])
    fit = jd.estimate_rigidity(problem, poses)
    return Done(
        np.full(mesh.vertices.shape, np.nan),
        np.asarray(fit.field),
        np.nan,
        float(fit.misfit),
        len(fit.history),
        0,
        name_of(fit.result),
        0.0,
    )
