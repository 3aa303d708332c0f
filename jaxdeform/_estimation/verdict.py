"""What the poses say of a part, by its interval alone."""

from enum import Enum

import numpy as np
from jaxtyping import Float


class Verdict(Enum):
    """What the poses say of a part.

    One rule: a side of the interval is open if it reaches 0 or infinity, or if, with the other
    side bounded, its end is more than a factor (10, unless ``determined_within`` says otherwise)
    from the best value.

    - determined: both sides are closed.
    - at_least: only the lower one is, and its end is the bound.
    - at_most: only the upper one is, and its end is the bound.
    - not_determined: neither is.

    Example:
        >>> import jaxdeform as jd
        >>> jd.Verdict.at_least.value
        'at least'
    """

    determined = "determined"
    at_least = "at least"
    at_most = "at most"
    not_determined = "not determined by these poses"

    @classmethod
    def of(cls, value: float, interval: Float[np.ndarray, "2"], factor: float) -> "Verdict":
        """Return the verdict on a value with an interval."""
        low, high = interval
        # Where one side is unbounded, so is the best value: the other end stands for itself.
        below = low > 0.0 if np.isinf(high) else low >= value / factor
        above = high < np.inf if low == 0.0 else high <= value * factor
        if below and above:
            return cls.determined
        if below:
            return cls.at_least
        return cls.at_most if above else cls.not_determined


def in_words(verdict: Verdict, value: float, interval: Float[np.ndarray, "2"]) -> str:
    """Return the value as far as it is known: an open interval by its closed end only."""
    low, high = interval
    if verdict is Verdict.determined:
        return f"{value:.4g} ({low:.4g} to {high:.4g})"
    if verdict is Verdict.at_least:
        return f"at least {low:.3g}"
    return f"at most {high:.3g}" if verdict is Verdict.at_most else verdict.value
