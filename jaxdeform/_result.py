"""How a computation ended, as a sentence."""

import operator
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxdeform._arrays import is_concrete


class Result(eqx.Enumeration):
    """How a computation ended; ``jd.Result[result]`` is the sentence.

    Compare with a member: ``out.result == jd.Result.converged`` (one boolean for each member of a
    batch).
    """

    __module__ = "jaxdeform"  # where users find it, also in its repr

    steps_done = "Ran the number of steps that was asked for."
    converged = "Converged: a further step would lower the energy by less than the tolerance."
    step_limit = (
        "Stopped at the step limit before the tolerance was reached: the shape is usable, but "
        "allow more steps (or loosen the tolerance) if you rely on derivatives."
    )
    saddle = (
        "At a saddle: the energy falls to both sides, and several descents from here did not end "
        "in a minimum. Begin from another shape (start), or come by a path (deform_path)."
    )
    not_finite = (
        "Not finite: a local step failed, or the numbers overflowed. The cells at fault are those "
        "whose `transforms` are not finite (`Solution.explain` names them). Try the default local "
        "step, float64, or another scale of the targets and the rigidity (its unit is length "
        "squared)."
    )
    bad_input = (
        "Not solved: a target, weight or rest position is not finite, a rigidity or weight is "
        "negative, a weight exceeds that of `precompute`, or the rest shape, the edge weights or "
        "the arrays are not those of the problem. Outside jit, `deform` names the entry."
    )
    out_of_proportion = (
        "Not to be trusted: the energy is negative, or vertices lie more than ten diagonals from "
        "the mesh and its targets. Check the targets, and whether a rigidity near 0 resists enough."
    )
    fitted = "Converged: a further step would not lower the misfit visibly."
    unexplained = (
        "Converged, but the model does not explain these poses: the residual is smooth, not noise. "
        "`discrepancy` and `explain()` say how large it is and where."
    )
    unsettled = (
        "Not settled: the misfit jumps between equilibria of the poses, so there is no interval. "
        "Try another start, poses that are less extreme, or a lower tolerance of the solver."
    )
    settled = "Stopped: rigidity changed by less than the threshold."
    evaluation_limit = (
        "Stopped at the limit of evaluations: allow more (max_evaluations), or start nearer."
    )
    fit_not_finite = (
        "Not finite: a deformation overflowed. Check the scale of the mesh, the observed poses and "
        "the start (rigidity is length squared), or use float64."
    )


def succeeded(result: Result) -> Bool[Array, "*batch"]:
    """Return whether a computation ended as it should."""
    good = Result.steps_done, Result.converged, Result.fitted, Result.settled
    return reduce(operator.or_, (result == member for member in good))


def check_result(out: Any, throw: bool) -> Any:
    """Return an output; with ``throw``, raise the sentence of its result where that is not ok."""
    if not throw:
        return out
    if not is_concrete(out.result):
        return out.result.error_if(out, ~succeeded(out.result))  # raised as the program runs
    # On one device: of a result that is divided, each device would wait for the others for ever.
    result = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), out.result)
    result.error_if(jnp.zeros(()), ~succeeded(result))
    return out


# Equinox does not list the members.
MEMBERS = (
    *("steps_done", "converged", "step_limit", "saddle", "not_finite", "bad_input"),
    *("out_of_proportion", "fitted", "unexplained", "unsettled", "settled", "evaluation_limit"),
    "fit_not_finite",
)
assert len(MEMBERS) == len(Result)


def name_of(result: Result) -> str:
    """Return the name of a member."""
    return next(name for name in MEMBERS if bool(result == getattr(Result, name)))
