"""What a solver and an adjoint are: the two protocols that ``deform`` is put together from."""

from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxdeform._checks import check_setting
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._deformation.system import System
from jaxdeform._linalg.varying import as_varying
from jaxdeform._result import Result


class Descent(NamedTuple):
    """Where a descent ended."""

    positions: Float[Array, "3 vertices"]
    transforms: Float[Array, "3 3 vertices"]
    """T_k of every cell at these positions, in its principal axes."""
    energy: Float[Array, "history"]
    """At the start and after each step; anything behind the last one."""
    steps: Int[Array, ""]
    result: Result


class Iterate(NamedTuple):
    """What one iteration hands to the next."""

    p: Float[Array, "3 vertices"]
    transforms: Float[Array, "3 3 vertices"]
    energy: Float[Array, ""]
    done: Bool[Array, ""]
    steps: Int[Array, ""]

    @staticmethod
    def before(start: Float[Array, "3 vertices"]) -> "Iterate":
        """Return the state before the first evaluation."""
        transforms = jnp.zeros((3, *start.shape), start.dtype)
        zero = jnp.zeros((), start.dtype)
        no, none = jnp.asarray(False), jnp.asarray(0, jnp.int32)
        return as_varying(Iterate(start, transforms, zero, no, none))


class Anchor(NamedTuple):
    """Where derivatives are taken: at the end of the descent, or at the minimum next to it."""

    positions: Float[Array, "3 vertices"]
    """With the derivatives of the end."""
    transforms: Float[Array, "3 3 vertices"]
    """At these positions, as numbers without derivatives."""


@runtime_checkable
class Adjoint(Protocol):
    """How derivatives are made: what ``deform(..., adjoint=)`` takes.

    **Fields**

    - needs_one_energy: True if it uses the gradient as that of one energy, which the normal term
      does not have.
    """

    needs_one_energy: ClassVar[bool]

    def check(self, solver: "Solver") -> None:
        """Raise InputError if derivatives cannot be made through this solver."""
        ...

    def solve(
        self,
        solver: "Solver",
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> tuple[Descent, Anchor]:
        """Run the solver, so that its positions and the anchor's have derivatives to the inputs."""
        ...


@runtime_checkable
class Solver(Protocol):
    """How the reduced energy is minimised: what ``deform(..., solver=)`` takes.

    **Fields**

    - can_unroll: True if its iterations can be differentiated in forward and reverse mode.
    - needs_one_energy: as for an adjoint.
    """

    can_unroll: ClassVar[bool]
    needs_one_energy: ClassVar[bool]

    @property
    def default_adjoint(self) -> Adjoint:
        """The adjoint where the caller names none."""
        ...

    def minimize(
        self,
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> Descent:
        """Iterate from a start, whose fixed vertices are on their targets."""
        ...


def choose_adjoint(solver: Any, adjoint: Any) -> Adjoint:
    """Return the adjoint, by default the solver's, or raise InputError: the two do not go together.

    Also if one of them is no solver, or no adjoint.
    """
    check_setting(
        "solver",
        solver,
        ("minimize", "default_adjoint", "can_unroll", "needs_one_energy"),
        "jd.QuasiNewton() or jd.Alternating()",
    )
    if adjoint is None:
        adjoint = solver.default_adjoint
    else:
        check_setting(
            "adjoint",
            adjoint,
            ("solve", "check", "needs_one_energy"),
            "jd.Implicit() or jd.Unrolled()",
        )
    adjoint.check(solver)
    return adjoint
