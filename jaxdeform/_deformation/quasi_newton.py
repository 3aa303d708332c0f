"""The default solver: L-BFGS on the reduced energy, preconditioned with the factor of A."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Array, Float

from jaxdeform._checks import check_count, check_tolerance
from jaxdeform._deformation.adjoint import Implicit
from jaxdeform._deformation.descent import Descent
from jaxdeform._deformation.problem import System
from jaxdeform._deformation.reduced_energy import Inputs, ReducedEnergy
from jaxdeform._linalg.lbfgs import Settings, minimize
from jaxdeform._result import Result


@dataclass(frozen=True)
class QuasiNewton:
    """L-BFGS on the reduced energy E(p') = min_T E(p', T), with A^-1 as initial inverse Hessian.

    The first step is the alternating one, and so is any step after a refused one: a step that
    would raise the energy is dropped together with the history. An iteration costs as much as an
    alternating one, and far fewer are needed. On the bar 41 come within 1e-4 of the minimum where
    alternating takes 145, and 72 within 1e-9 where it takes 519.

    Nocedal, "Updating quasi-Newton matrices with limited storage", 1980.

    Example:
        >>> import jaxdeform as jd
        >>> jd.QuasiNewton(tolerance=1e-12).max_steps
        500
    """

    tolerance: float = 1e-8
    """Stop once a plain step is expected to lower the energy by less than this fraction of it."""
    max_steps: int = 500
    """Most iterations."""
    history_length: int = 6
    """Number of past steps that shape the next one."""

    can_unroll: ClassVar[bool] = False
    needs_one_energy: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_tolerance("tolerance of QuasiNewton", self.tolerance)
        check_count("max_steps of QuasiNewton", self.max_steps)
        check_count("history_length of QuasiNewton", self.history_length, most=1000)

    @property
    def default_adjoint(self) -> Implicit:
        """Implicit: the loop has no reverse mode."""
        return Implicit()

    def minimize(
        self,
        energy: ReducedEnergy,
        system: System,
        inputs: Inputs,
        start: Float[Array, "3 vertices"],
    ) -> Descent:
        """Iterate until converged; under vmap the batch is a queue (linalg/lbfgs.py)."""
        settings = Settings(self.tolerance, self.max_steps, self.history_length)
        end = minimize(energy.evaluate_batch, system, inputs, start, settings)
        result = Result.where(end.converged, Result.converged, Result.step_limit)
        return Descent(end.p, end.transforms, end.energy, end.steps, result)
