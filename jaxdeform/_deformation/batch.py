"""Many deformations of one mesh, in chunks that fit the memory, on all devices."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Float

from jaxdeform._arrays import is_concrete, read_numbers
from jaxdeform._checks import check_count, check_flag, check_function
from jaxdeform._deformation.arguments import DeformSettings, read_settings, read_weights
from jaxdeform._deformation.descent import Solver
from jaxdeform._deformation.local_step import LocalStep, Newton
from jaxdeform._deformation.problem import Problem, check_problem
from jaxdeform._deformation.reduced_energy import Inputs
from jaxdeform._deformation.solve import Solution, cut_to_mesh, solve
from jaxdeform._deformation.system import System
from jaxdeform._errors import ArrayLike, InputError, have
from jaxdeform._linalg.buckets import fill_up
from jaxdeform._linalg.lbfgs import SLOTS
from jaxdeform._linalg.xla import AS_FAST, quick_jit
from jaxdeform._result import check_result

# Arrays of a member, in numbers per vertex: targets, start, rigidity, positions, transforms, and
# what the compiler keeps of them meanwhile.
_NUMBERS = 40
# Chunks that are computed at the same time. While one is at its end, where few members are left, or
# is copied, the other keeps the cores busy. That pays for many members: two chunks take 0.93 of the
# time of one for 1,024 and 256 bars, but 1.05 for 64, and 1.15 for 64 tubes of 5,000 vertices.
_IN_FLIGHT = 2
_MANY = 16 * SLOTS

MEMORY = 2**30


def deform_batch(
    problem: Problem,
    targets: ArrayLike,
    rigidity: ArrayLike,
    *,
    local: LocalStep = Newton(),  # noqa: B008 (frozen)
    solver: Solver | None = None,
    start: ArrayLike | None = None,
    handle_weights: ArrayLike | None = None,
    normals: bool = False,
    memory: int = MEMORY,
    progress: Callable[[int, int], Any] | None = None,
    throw: bool = False,
) -> Solution:
    """Deform one mesh many times: other targets, other rigidities, or both.

    Each member of the batch is what `deform` makes of it alone. The batch runs in chunks that fit
    the memory, on all devices of JAX (``jax.devices()``), each with a queue of its own.

    For derivatives, or inside jit, use ``jax.vmap`` of `deform` (docs/recipes.md says which to use
    when). For more results than fit the memory, use `deform_in_chunks`.

    Where ``jax.distributed`` connects several processes, all of them call this with the same
    arguments, and each returns the whole batch.

    **Arguments**

    - problem: from `precompute`.
    - targets: (batch, handles, 3), or (handles, 3) for the same in all. A ``numpy.memmap`` is read
      chunk by chunk.
    - rigidity: a number; (batch,), one number for each member; (batch, vertices); or
      (1, vertices), the same field for all.
    - start: (vertices, 3) or (batch, vertices, 3), as in `deform`.
    - local, solver, handle_weights (handles,), normals: as in `deform`, the same for all.
    - memory: bytes that the arrays of the chunks at work may take, on each device.
    - progress: called with the number of members done and of all members, after each chunk.
    - throw: raise an error if a member is not ``ok``. By default its ``result`` says so.

    **Returns** a `Solution` whose arrays have a leading axis of members.

    **Raises** InputError: shapes that do not fit; something else where a setting belongs; values
    that JAX traces. An entry that is not finite, or a negative rigidity, does not raise: the
    ``result`` of its member is ``bad_input``, and the others are deformed.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> problem = jd.precompute(mesh, handles)
        >>> rest = mesh.vertices[handles.vertices]
        >>> bends = [jd.bend(rest, degrees) for degrees in (0, 30, 60, 90)]
        >>> out = jd.deform_batch(problem, bends, rigidity=[1.0, 1.0, 30.0, 30.0])
        >>> out.vertices.shape, bool(out.ok.all())
        ((4, 722, 3), True)
    """
    check_flag("throw", throw)
    check_function("progress", progress, "members done, members")
    total, chunks = _planned(
        problem, targets, rigidity, start, handle_weights, local, solver, normals, memory
    )
    done = []
    for members, part in chunks:
        done.append(part)
        if progress is not None:
            progress(members.stop, total)
    out = jax.tree.map(lambda *x: jnp.concatenate(x), *done) if len(done) > 1 else done[0]
    return check_result(out, throw)


def deform_in_chunks(
    problem: Problem,
    targets: ArrayLike,
    rigidity: ArrayLike,
    *,
    local: LocalStep = Newton(),  # noqa: B008 (frozen)
    solver: Solver | None = None,
    start: ArrayLike | None = None,
    handle_weights: ArrayLike | None = None,
    normals: bool = False,
    memory: int = MEMORY,
) -> Iterator[tuple[slice, Solution]]:
    """Deform one mesh many times, and return the results chunk by chunk.

    The arguments are those of `deform_batch`, and checked at once. Nothing is kept of a chunk that
    was taken, so that a batch of any length fits. The next chunk is computed meanwhile.

    **Returns** an iterator over pairs: the members as a slice, in order, and their `Solution`.

    **Raises** InputError as `deform_batch`.

    Example:
        >>> import jaxdeform as jd, numpy as np
        >>> mesh = jd.shapes.bar()
        >>> handles = jd.select.where(mesh, "y < 6 or y > 145")
        >>> problem = jd.precompute(mesh, handles)
        >>> bent = jd.bend(mesh.vertices[handles.vertices], 30.0)
        >>> heights = np.zeros(20)
        >>> lam = np.geomspace(0.1, 10.0, 20)
        >>> for members, out in jd.deform_in_chunks(problem, bent, lam, memory=10**6):
        ...     heights[members] = out.vertices[:, :, 1].max(axis=1)
        >>> bool((heights > 100).all())
        True
    """
    return _planned(
        problem, targets, rigidity, start, handle_weights, local, solver, normals, memory
    )[1]


def _planned(
    problem, targets, rigidity, start, handle_weights, local, solver, normals, memory
) -> tuple[int, Iterator[tuple[slice, Solution]]]:
    """Check all arguments; return the number of members, and the chunks, none begun."""
    check_problem(problem)
    check_count("memory of the chunks, in bytes,", memory, most=2**62)
    settings = read_settings(problem.dtype, local, solver, None, normals)
    soft = read_weights(problem, handle_weights)
    batch = _Batch.read(problem, targets, rigidity, start)
    length = _size_of_chunk(problem, batch.size, memory)
    return batch.size, _chunks(problem, batch, soft, settings, length)


class _Batch(NamedTuple):
    """The arguments that may differ between members; what is the same for all has size 1."""

    size: int
    targets: Float[np.ndarray, "members handles 3"]
    rigidity: Float[np.ndarray, "members vertices"]
    start: Float[np.ndarray, "members vertices 3"] | None

    @staticmethod
    def read(
        problem: Problem, targets: ArrayLike, rigidity: ArrayLike, start: ArrayLike | None
    ) -> "_Batch":
        if not is_concrete(problem):
            raise InputError(
                "problem: traced by JAX (jit, vmap or grad), but a batch is computed at once: use "
                "jax.vmap of jd.deform there"
            )
        n = problem.n_vertices
        wanted = {"targets": (len(problem.handles), 3), "rigidity": (n,), "start": (n, 3)}
        given = {"targets": read_numbers(targets, "targets")}
        given["rigidity"] = read_numbers(rigidity, "rigidity")
        if start is not None:
            given["start"] = read_numbers(start, "start")
        if given["rigidity"].ndim < 2:  # numbers, the same at all vertices
            given["rigidity"] = np.broadcast_to(
                given["rigidity"].reshape(-1, 1), (given["rigidity"].size, n)
            )
        sizes = {}
        for name, array in given.items():
            if array.ndim == len(wanted[name]):
                given[name] = array = array[None]
            if array.shape[1:] != wanted[name] or not len(array):
                last = ", ".join(map(str, wanted[name]))
                raise InputError(
                    f"{name} {have(name)} shape {array.shape}: give (batch, {last}), at least "
                    "one member"
                )
            sizes[name] = len(array)
        most = "targets" if sizes["targets"] > 1 else max(sizes, key=lambda name: sizes[name])
        size = sizes[most]
        for name, own in sizes.items():
            if own not in (1, size):
                hint = f", or (1, {n}) for one field" if name == "rigidity" else ""
                raise InputError(
                    f"{name} {have(name)} {own} members, but {most} {have(most)} {size}: give as "
                    f"many, or one for all{hint}"
                )
        return _Batch(size, given["targets"], given["rigidity"], given.get("start"))

    def rows(self, name: str, members: slice) -> np.ndarray:
        """Return the values of some members. Beyond the last one it is repeated."""
        array = getattr(self, name)
        index = np.minimum(np.arange(members.start, members.stop), self.size - 1)
        return np.asarray(array[index if len(array) > 1 else np.zeros_like(index)])


def _size_of_chunk(problem: Problem, size: int, memory: int) -> int:
    """Return how many members a chunk has: all chunks are alike, and compile once."""
    devices = jax.device_count()
    member = _NUMBERS * problem.bucket * problem.dtype.itemsize
    most = max(1, memory // (member * _IN_FLIGHT)) * devices
    count = -(-size // most)
    if size >= _MANY * devices:
        count = max(count, _IN_FLIGHT)
    return -(-size // (count * devices)) * devices


def _chunks(
    problem: Problem, batch: _Batch, soft: Any, settings: DeformSettings, length: int
) -> Iterator[tuple[slice, Solution]]:
    devices = jax.make_mesh((jax.device_count(),), ("batch",), axis_types=(AxisType.Auto,))
    numbers, settings = settings.apart(problem.dtype)
    whole = problem.system, soft, numbers
    system, soft, numbers = _everywhere(devices, PartitionSpec(), whole)
    waiting: list[tuple[int, Solution]] = []
    for first in range(0, batch.size, length):
        own = _read_chunk(problem, batch, slice(first, first + length))
        own = _everywhere(devices, PartitionSpec("batch"), own)
        waiting.append((first, _solve_chunk(system, soft, own, numbers, settings, devices)))
        if len(waiting) == _IN_FLIGHT:
            yield _finished(waiting.pop(0), batch.size, problem.n_vertices)
    for chunk in waiting:
        yield _finished(chunk, batch.size, problem.n_vertices)


def _read_chunk(problem: Problem, batch: _Batch, members: slice) -> tuple[Any, ...]:
    """Return targets, rigidity and start, as the compiled code takes them."""
    center, dtype, handles = problem.mesh.center, problem.dtype, np.asarray(problem.handles)

    def relative(name: str) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):  # ends in bad_input
            return (batch.rows(name, members) - center).swapaxes(-1, -2).astype(dtype)

    count = members.stop - members.start
    size = problem.bucket
    spread = np.array(np.broadcast_to(np.asarray(problem.system.rest), (count, 3, size)))
    spread[..., handles] = relative("targets")
    with np.errstate(over="ignore"):
        rigidity = fill_up(batch.rows("rigidity", members).astype(dtype), size)
    return spread, rigidity, None if batch.start is None else fill_up(relative("start"), size)


def _everywhere(devices: jax.sharding.Mesh, spec: PartitionSpec, arrays: Any) -> Any:
    """Put arrays on all devices, whole or in parts; all processes have the same ones."""
    place = NamedSharding(devices, spec)
    if jax.process_count() == 1:
        return jax.device_put(arrays, place)

    def put(x):
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, place, lambda index: host[index])

    return jax.tree.map(put, arrays)


@quick_jit(static=("settings", "devices"), options=AS_FAST)
def _solve_chunk(
    system: System,
    soft: Any,
    own: tuple[Any, ...],
    numbers: Any,
    settings: DeformSettings,
    devices: jax.sharding.Mesh,
) -> Solution:
    def some(system, soft, numbers, own):
        known = settings.together(numbers)

        def one(own):
            targets, rigidity, start = own
            return solve(system, Inputs(targets, rigidity, soft), start, known)

        return jax.vmap(one)(own)

    whole, part = PartitionSpec(), PartitionSpec("batch")
    places = whole, whole, whole, part
    # Nothing is summed over devices, so what differs between them need not be followed: the loops
    # of other local steps (jaxopt's, a user's own) do not.
    run = jax.shard_map(some, mesh=devices, in_specs=places, out_specs=part, check_vma=False)
    return run(system, soft, numbers, own)


def _finished(chunk: tuple[int, Solution], size: int, count: int) -> tuple[slice, Solution]:
    """Wait for a chunk; cut off what only filled it up."""
    first, out = chunk
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        out = jax.tree.map(partial(multihost_utils.process_allgather, tiled=True), out)
    last = min(first + len(out.steps), size)
    out = jax.tree.map(lambda x: jnp.asarray(x[: last - first]), out)
    return slice(first, last), cut_to_mesh(out, count)
