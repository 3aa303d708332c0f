"""Intervals cover the truth as often as they say, with the whole nonlinear estimate."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.coverage import Bar, Case

# Five bounds below: together they fail by chance in less than 1 of 10,000 runs.
CHANCE = 1e-4 / 5


@pytest.fixture(scope="module")
def draw():
    return Bar().draw


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "seeds"),
    [
        (Case(1, True, 1e-3), 60),
        (Case(1, False, 1e-3), 20),
        (Case(2, True, 1e-3), 12),
    ],
)
def test_intervals_cover_the_truth(draw, case, seeds):
    """Seeds that the benchmark does not use, and noise that hides the solver's own error.

    The count of covered truths is binomial, with 95 % each: below its quantile at ``CHANCE`` it is
    not. The middle half of a Student interval covers in 67 to 79 % (three degrees of freedom or
    more): an interval far too wide would cover with its middle half too.
    """
    draws = [draw(case, 10_000 + seed) for seed in range(seeds)]
    covered = np.sum([each.covered for each in draws], axis=0)
    assert covered.shape == (case.parts,)
    assert covered.min() >= stats.binom.ppf(CHANCE, seeds, 0.95)
    if seeds >= 60:
        central = np.sum([each.central for each in draws])
        assert central <= stats.binom.isf(CHANCE, seeds, 0.79) < seeds
