"""How far an estimate is from the truth, judged by the residual that it leaves.

The textbook's interval takes the residual for independent noise. Where the model is a little wrong,
the residual is smooth instead, and that interval covers the truth in 3 to 27 % of the cases instead
of 95. Here the variance of the residual is measured pattern by pattern, from the smoothest on (a
spectrum), and the covariance of the estimate follows from it: A (sum_k v_k J_k^T J_k) A with
A = (J^T J)^-1, a sandwich. With independent noise the intervals are hardly wider than the
textbook's; with smooth errors they cover in 90 to 97 % (docs/estimation-measured.md).

Tried and worse: a Gaussian process with generalised least squares (covers in 11 %: it trusts the
patterns of little noise, where it extrapolates), clusters and block bootstrap (7 %), an effective
number of observations (covers, and is too wide to be of use).
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from scipy import special

# The logarithm of the spectrum is a quadratic spline in the logarithm of the pattern's number, with
# a penalty on its second differences.
_KNOTS, _PENALTY = 9, 2.0
# Rounds of taking out what the fit itself removes from the residual, and of fitting the spline.
_ROUNDS, _SPLINE_STEPS = 6, 12


class Spread(NamedTuple):
    """How far the estimates may be from the truth."""

    half_width: Float[np.ndarray, "parts"]
    """Of the 95 % intervals."""
    inverse: Float[np.ndarray, "parts"]
    """Diagonal of (J^T J)^-1."""


def spread(
    jacobian: Float[np.ndarray, "poses vertices 3 parts"],
    residual: Float[np.ndarray, "poses vertices 3"],
    modes: Float[np.ndarray, "poses vertices modes"],
    count: int,
    floor: float,
    free: Float[np.ndarray, "poses vertices 3 free"],
) -> Spread:
    """Return the spread of least squares from the spectrum of its residual.

    ``count`` coordinates were compared; ``floor`` is the least standard deviation of one;
    ``free`` are directions of each pose that were fitted too (orthonormal, and orthogonal to the
    Jacobian and the residual).
    """
    model = _Normal.of(jacobian, modes, free)
    parts = jacobian.shape[-1]
    by_mode = np.sum(np.einsum("pnk,pnc->pkc", modes, residual) ** 2, axis=(0, 2))
    rest_freedom = max(count - 3 * len(modes) * modes.shape[2] - model.rest_leverage, 1.0)
    rest = max((np.sum(residual**2) - by_mode.sum()) / rest_freedom, floor**2)
    spectrum, uncertainty = _spectrum(model, by_mode, 3 * len(modes), rest, floor)
    shares, rest_share = model.shares(parts)
    variance = spectrum @ shares + rest * rest_share
    slopes = (spectrum[:, None] * shares).T @ _splines(len(spectrum))
    doubt = np.einsum("ai,ij,aj->a", slopes, uncertainty, slopes)
    doubt += 2.0 * (rest * rest_share) ** 2 / rest_freedom
    # Satterthwaite's degrees of freedom, of a variance that is itself an estimate.
    freedom = np.clip(2.0 * variance**2 / np.maximum(doubt, 1e-300), 1.0, 1e6)
    width = special.stdtrit(freedom, 0.975) * np.sqrt(variance)
    return Spread(width, np.diag(model.inverse)[:parts])


class _Normal(NamedTuple):
    """The normal equations, split into patterns."""

    inverse: Float[np.ndarray, "columns columns"]
    by_mode: Float[np.ndarray, "modes columns columns"]
    """J_k^T J_k."""
    rest: Float[np.ndarray, "columns columns"]
    """What the patterns leave of J^T J."""

    @classmethod
    def of(cls, jacobian, modes, free) -> "_Normal":
        """Split; the free directions of each pose are columns of their own."""
        poses, parts, extra = len(jacobian), jacobian.shape[-1], free.shape[-1]
        columns = parts + poses * extra
        by_mode, whole = np.zeros((modes.shape[2], columns, columns)), np.zeros((columns, columns))
        for pose in range(poses):
            own = np.r_[:parts, parts + extra * pose + np.arange(extra)].astype(int)
            block = np.concatenate([jacobian[pose], free[pose]], axis=-1)
            along = np.einsum("nk,nca->kca", modes[pose], block)
            by_mode[:, own[:, None], own] += np.einsum("kca,kcb->kab", along, along)
            whole[own[:, None], own] += np.einsum("nca,ncb->ab", block, block)
        # A part without influence gets a wide interval, not a singular matrix.
        ridge = np.finfo(float).eps * max(np.trace(whole[:parts, :parts]), 1e-300)
        inverse = np.linalg.inv(whole + ridge * np.eye(columns))
        return cls(inverse, by_mode, whole - by_mode.sum(axis=0))

    @property
    def rest_leverage(self) -> float:
        """Degrees of freedom that the fit takes from the rest."""
        return float(np.sum(self.rest * self.inverse))

    def shares(self, parts: int):
        """Return what each pattern, and the rest, of variance 1 add to that of each part."""
        rows = self.inverse[:parts]
        by_mode = np.einsum("ai,kij,aj->ka", rows, self.by_mode, rows)
        return by_mode, np.einsum("ai,ij,aj->a", rows, self.rest, rows)


def _spectrum(model: _Normal, found, freedom: int, rest: float, floor: float):
    """Return the variance of each pattern, and the covariance of the spline behind it.

    ``found`` is the sum of squares of each pattern in the residual, of so many coordinates. The fit
    has taken its part out of it; that is put back.
    """
    if not len(found):
        return np.zeros(0), np.zeros((0, 0))
    leverage = np.einsum("kij,ji->k", model.by_mode, model.inverse)
    smooth = np.convolve(np.pad(found, 3, mode="edge"), np.ones(7) / 7.0, "valid")
    spectrum = np.maximum(smooth / freedom, floor**2)
    uncertainty = np.zeros((0, 0))
    for _ in range(_ROUNDS):
        whole = np.tensordot(spectrum, model.by_mode, 1) + rest * model.rest
        back = np.einsum("kij,ji->k", model.by_mode, model.inverse @ whole @ model.inverse)
        squares = np.maximum(found + 2.0 * leverage * spectrum - back, 0.1 * found)
        fitted, uncertainty = _fit_spline(squares, freedom, spectrum)
        spectrum = np.maximum(fitted, floor**2)
    return spectrum, uncertainty


@cache
def _splines(count: int) -> Float[np.ndarray, "modes splines"]:
    """Return quadratic B-splines at the logarithms of the patterns' numbers."""
    if not count:
        return np.zeros((0, 0))
    at = np.log(np.arange(count) + 2.0)
    inner = np.linspace(at[0], at[-1], _KNOTS)
    step = inner[1] - inner[0]
    below, above = inner[0] - step * np.arange(2, 0, -1), inner[-1] + step * np.arange(1, 3)
    inside = np.clip(at, inner[0], inner[-1] - 1e-9)
    return scipy.interpolate.BSpline.design_matrix(
        inside, np.concatenate([below, inner, above]), 2
    ).toarray()


def _fit_spline(squares, freedom: int, start):
    """Fit the variances behind sums of squares: a gamma likelihood, by Newton's method."""
    splines = _splines(len(squares))
    differences = np.diff(np.eye(splines.shape[1]), 2, axis=0)
    penalty = _PENALTY * differences.T @ differences
    weight = 0.5 * freedom
    heights = np.linalg.lstsq(splines, np.log(start), rcond=None)[0]
    for _ in range(_SPLINE_STEPS):
        ratio = np.clip(squares / (freedom * np.exp(splines @ heights)), 0.0, 20.0)
        curvature = weight * splines.T @ splines + penalty + 1e-8 * np.eye(len(penalty))
        step = np.linalg.solve(curvature, weight * splines.T @ (ratio - 1.0) - penalty @ heights)
        heights = heights + step * min(1.0, 1.5 / max(np.abs(step).max(), 1e-300))
        if np.abs(step).max() < 1e-5:
            break
    return np.exp(splines @ heights), np.linalg.inv(curvature)
