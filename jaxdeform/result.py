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
        "Not finite: the numbers overflowed, or a local step failed. See which cells of "
        "`transforms` are not finite, check the scale of the targets and of the rigidity (its unit "
        "is length squared), try the default local step, or use float64."
    )
