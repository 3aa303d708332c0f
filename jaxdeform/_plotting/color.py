"""Colours for numbers: from warm and soft to cool and stiff, and the marks of a colour bar."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Anchors of the colour map. It runs through them at even steps in Oklab, where equal distances
# look equal; lightness falls from 0.87 to 0.50, so that it also reads in grey.
_ANCHORS = ("#ffd588", "#fbae90", "#dd93b2", "#a98fce", "#7590d6", "#3f86cf")
NEUTRAL = "#c3cfdd"
UNKNOWN = "#b9b9b9"

# Oklab (B. Ottosson, 2020): linear sRGB to cone responses, and their cube roots to (L, a, b).
_TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_TO_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def rgb(color: str) -> Float[np.ndarray, "3"]:
    """Return three numbers from 0 to 1 of a colour such as ``#ffcf7d``."""
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255


def _ramp(steps: int = 256) -> Float[np.ndarray, "steps 3"]:
    given = np.stack([rgb(color) for color in _ANCHORS])
    linear = np.where(given <= 0.04045, given / 12.92, ((given + 0.055) / 1.055) ** 2.4)
    lab = np.cbrt(linear @ _TO_CONES.T) @ _TO_LAB.T
    far = np.append(0, np.cumsum(np.linalg.norm(np.diff(lab, axis=0), axis=1)))
    at = np.linspace(0, far[-1], steps)
    lab = np.stack([np.interp(at, far, column) for column in lab.T], axis=1)
    linear = (lab @ np.linalg.inv(_TO_LAB).T) ** 3 @ np.linalg.inv(_TO_CONES).T
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


RAMP = _ramp()


class Scale(NamedTuple):
    """How numbers become colours, the same in all panels."""

    low: float
    high: float
    log: bool
    whole: bool
    """All numbers are whole, such as rings."""

    def place(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return where numbers lie on the bar, from 0 to 1."""
        if self.low == self.high:
            return np.where(np.isnan(values), np.nan, 0.5)
        low, high = self.low, self.high
        if self.log:
            with np.errstate(divide="ignore", invalid="ignore"):
                low, high, values = np.log(low), np.log(high), np.log(values)
        # Halves, because the difference of two numbers may overflow.
        return np.asarray(np.clip((values / 2 - low / 2) / (high / 2 - low / 2), 0, 1))

    def colors(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 3"]:
        """Return red, green and blue from 0 to 1; grey where there is no number."""
        place = self.place(values)
        finite = np.isfinite(place)
        index = np.rint(np.where(finite, place, 0) * (len(RAMP) - 1)).astype(int)
        return np.where(finite[..., None], RAMP[index], rgb(UNKNOWN))

    def bar(self, length: int) -> Float[np.ndarray, "length 3"]:
        """Return the colours from the lowest number to the highest."""
        place = np.linspace(0, 1, length) if self.low < self.high else np.full(length, 0.5)
        return RAMP[np.rint(place * (len(RAMP) - 1)).astype(int)]

    def marks(self, closest: float) -> list[float]:
        """Return the numbers to write at the bar: both ends, and round ones between.

        No two lie closer to each other than ``closest``, a fraction of the bar's length.
        """
        ends = [self.low, self.high][: 1 + (self.high > self.low)]
        kept = list(ends)
        for mark in self._round():
            if np.abs(self.place(np.array(kept)) - self.place(np.array(mark))).min() >= closest:
                kept.append(mark)
        return sorted(kept)

    def _round(self) -> list[float]:
        if self.low == self.high:
            return []
        if self.log:
            powers = np.arange(np.ceil(np.log10(self.low)), np.floor(np.log10(self.high)) + 1)
            step = max(1, len(powers) // 6)
            return [float(10.0**k) for k in powers[::step]]
        span = self.high / 4 - self.low / 4
        unit = 10.0 ** np.floor(np.log10(span))
        step = next(unit * k for k in (1, 2, 5, 10) if unit * k >= span * 0.7)
        if self.whole:
            step = max(1.0, np.rint(step))
        first = np.ceil(self.low / step) * step
        with np.errstate(over="ignore"):
            return [float(first + k * step) for k in range(10) if first + k * step < self.high]


def scale_of(values: list[Float[np.ndarray, "vertices"]]) -> Scale | None:
    """Return a scale for all numbers; logarithmic if they are positive and differ 5 times."""
    finite = [v[np.isfinite(v)] for v in values]
    finite = [v for v in finite if v.size]
    if not finite:
        return None
    low, high = float(min(v.min() for v in finite)), float(max(v.max() for v in finite))
    whole = all((v == np.rint(v)).all() for v in finite) and high - low < 20
    return Scale(low, high, log=0 < low < high / 5 and not whole, whole=whole)


def written(number: float) -> str:
    """Return a number in a few characters."""
    return f"{number:.3g}".replace("e-0", "e-").replace("e+0", "e")
