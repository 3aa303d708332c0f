"""Many problems as one, for jax.vmap."""

from collections.abc import Sequence

import jax
import numpy as np

from jaxdeform._arrays import is_concrete
from jaxdeform._deformation.problem import Problem, check_problem
from jaxdeform._errors import InputError, a_or_an
from jaxdeform._linalg.cholesky import own_factors


def stack_problems(problems: Sequence[Problem]) -> Problem:
    """Stack problems of different meshes, so that ``jax.vmap`` deforms all of them in one call.

    The meshes must be of about one size: arrays have one of four sizes a doubling, and those of all
    problems must be alike. Each mesh is filled up to that size with fixed vertices at its centre.
    So of the results, the first ``problem.n_vertices`` rows are those of a mesh. A rigidity field
    has as many entries as the arrays, ``stack.n_vertices``; the last ones are not read.

    On a CPU the meshes are deformed one after another, in one program: as fast as a loop over
    `deform`, which needs no stack. It is there for what is written once under ``jax.vmap``: losses
    and gradients over many objects.

    **Arguments**: problems, at least one, from `precompute`.

    **Returns** a `Problem` whose arrays have a leading axis, for ``jax.vmap`` only.

    **Raises** InputError: none; one is no problem, or a stack; arrays of different sizes or types,
    which names the first that differs; another number of handles.

    Example:
        >>> import jax, numpy as np
        >>> import jaxdeform as jd
        >>> bar = jd.shapes.bar()
        >>> longer = jd.Mesh(bar.vertices * [1.0, 1.5, 1.0], bar.faces)
        >>> ends = jd.select.where(bar, "y < 6 or y > 145").vertices
        >>> problems = [jd.precompute(mesh, ends) for mesh in (bar, longer)]
        >>> targets = np.stack([jd.bend(p.vertices[ends], 45.0) for p in problems])
        >>> one = lambda problem, targets: jd.deform(problem, targets, 1.0).vertices
        >>> out = jax.vmap(one)(jd.stack_problems(problems), targets)
        >>> out[1, : longer.n_vertices].shape
        (722, 3)
    """
    if isinstance(problems, Problem) or not isinstance(problems, Sequence):
        raise InputError(f"problems is {a_or_an(problems)}: give a list of problems")
    if not problems:
        raise InputError("problems is empty: give at least one")
    for problem in problems:
        check_problem(problem)
    first = problems[0]
    for k, problem in enumerate(problems):
        if not is_concrete(problem):
            raise InputError(f"problem {k} is traced by JAX: stack problems outside of jit")
        if len(problem.handles) != len(first.handles):
            raise InputError(
                f"problem {k} has {len(problem.handles)} handles, but the first has "
                f"{len(first.handles)}: choose as many on each mesh"
            )
        if _shapes(problem) != _shapes(first):
            raise InputError(
                f"problem {k} ({problem}) has arrays of other sizes than the first ({first}): "
                "stack meshes of about one size, with cells of one kind and numbers of one type"
            )
    systems = [problem.system for problem in problems]
    stacked = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *systems)
    system = jax.device_put(stacked)
    own_factors(system)
    return Problem(system, np.stack([p.handles for p in problems]), None)


def _shapes(problem: Problem) -> object:
    leaves, structure = jax.tree.flatten(problem.system)
    return structure, [(x.shape, x.dtype) for x in leaves]
