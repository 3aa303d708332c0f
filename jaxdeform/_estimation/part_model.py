"""What is fitted: deformed poses as a function of one log rigidity per part."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Float, Int

from jaxdeform._deformation.descent import Adjoint, Solver
from jaxdeform._deformation.problem import Problem
from jaxdeform._estimation.bounded_gauss_newton import Evaluation
from jaxdeform._estimation.deformed import PoseDerivatives, State, deform_all, states
from jaxdeform._estimation.noise import HandleNoise
from jaxdeform._estimation.poses import MEDIUM, Poses, check_start, log_bounds, sizes


class Fit(NamedTuple):
    """One evaluation: the poses at log rigidity theta, and the linear model there."""

    theta: Float[np.ndarray, "parts"]
    vertices: Float[np.ndarray, "poses vertices 3"]
    jacobian: Float[np.ndarray, "poses vertices 3 parts"]
    residual: Float[np.ndarray, "poses vertices 3"]
    solver_error: Float[np.ndarray, "poses vertices 3"]
    ends: list[State]
    noise: HandleNoise
    """What the weights W allow for."""
    triangle: Float[np.ndarray, "rows columns"]
    """R of the QR decomposition of W^(1/2) [J, r]: all that a search needs of the equations."""

    @property
    def normal(self) -> Float[np.ndarray, "parts parts"]:
        """J^T W J."""
        return self.triangle[:, :-1].T @ self.triangle[:, :-1]

    @property
    def cost(self) -> float:
        """r^T W r."""
        return float(self.triangle[:, -1] @ self.triangle[:, -1])

    @property
    def white(self) -> tuple[np.ndarray, np.ndarray]:
        """W^(1/2) J and W^(1/2) r, by pose and vertex."""
        shape = self.residual.shape
        jacobian = self.noise.whiten(self.jacobian.reshape(shape[0], -1, len(self.theta)))
        residual = self.noise.whiten(self.residual.reshape(shape[0], -1, 1))
        return jacobian.reshape(*shape, -1), residual.reshape(shape)

    @property
    def evaluation(self) -> Evaluation:
        """The linear model as the search takes it."""
        matrix = lx.MatrixLinearOperator(jnp.asarray(self.triangle[:, :-1]))
        return Evaluation(jnp.asarray(self.theta), jnp.asarray(self.triangle[:, -1]), matrix)


@dataclass(frozen=True, eq=False)
class PartModel:
    """The deformations that are compared with the poses."""

    problem: Problem
    poses: Poses
    label: Int[np.ndarray, "vertices"]
    """The part of each vertex."""
    solver: Solver
    adjoint: Adjoint
    size: Float[np.ndarray, "parts"]
    """Rigidity of each part at material constant 1."""

    @classmethod
    def build(cls, problem, poses, label, solver, adjoint) -> "PartModel":
        """Measure the parts: a part is as large as its typical cell."""
        each = sizes(problem)
        size = np.array([np.median(each[label == k]) for k in range(label.max() + 1)])
        return cls(problem, poses, label, solver, adjoint, size)

    @property
    def bounds(self) -> Float[np.ndarray, "2 parts"]:
        """Lowest and highest log rigidity."""
        return log_bounds(self.size)

    def start(self, given) -> Float[np.ndarray, "parts"]:
        """Return the log rigidity to start from: that given, or a medium material."""
        return np.clip(np.log(check_start(given, MEDIUM * self.size, "part")), *self.bounds)

    def field(self, theta: np.ndarray) -> Float[np.ndarray, "vertices"]:
        """Return the rigidity of each vertex."""
        return np.exp(theta)[self.label]

    def fit(self, theta: np.ndarray, noise: HandleNoise) -> Fit:
        """Deform into all poses, and weight the residual for the noise of the handles."""
        found = deform_all(self.problem, self.poses, self.label, theta, self.solver, self.adjoint)
        return self.weighted(theta, found, noise)

    def weighted(self, theta, derivatives: PoseDerivatives | Fit, noise: HandleNoise) -> Fit:
        """Return the linear model, weighted for this noise."""
        jacobian, residual = derivatives.jacobian, derivatives.residual
        columns = np.concatenate([jacobian, residual[..., None]], axis=-1, dtype=np.float64)
        white = noise.whiten(columns.reshape(len(residual), -1, len(theta) + 1))
        triangle = np.asarray(np.linalg.qr(white.reshape(-1, len(theta) + 1), mode="r"))
        vertices, error = derivatives.vertices, derivatives.solver_error
        ends = derivatives.ends
        return Fit(theta, vertices, jacobian, residual, error, ends, noise, triangle)

    def ends(self, theta: np.ndarray) -> list[State]:
        """Deform into all poses, without derivatives."""
        field = self.field(theta).astype(self.problem.dtype)
        return states(self.problem, self.poses, field, self.solver, self.adjoint)
