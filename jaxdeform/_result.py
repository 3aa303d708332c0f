"""How a computation ended, as a sentence."""

import equinox as eqx


class Result(eqx.Enumeration):
    """How a computation ended; ``jd.Result[result]`` is the sentence.

    Compare with a member: ``out.result == jd.Result.converged`` (one boolean for each member of a
    batch).
    """

    __module__ = "jaxdeform"  # where users find it, also in its repr

    steps_done = "Ran the number of steps that was asked for."
    converged = "Converged: a further step would change the objective by less than the tolerance."
    step_limit = (
        "Stopped at the step limit before the tolerance was reached: the shape is usable, but "
        "allow more steps (or loosen the tolerance) if you rely on derivatives."
    )
    not_finite = (
        "Not finite: a local step failed, or the numbers overflowed. The cells at fault are those "
        "whose `transforms` are not finite (`Solution.explain` names them). Try the default local "
        "step, float64, or another scale of the targets and the rigidity (its unit is length "
        "squared)."
    )
