"""Statistics of a sample of runs: intervals, paired tests, ranks, Pareto fronts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.proportion import proportion_confint

from qpavoid.problem import Array

CONFIDENCE = 0.95
"""Confidence of all intervals and tests."""
_RESAMPLES = 2000
_MANY = 3000
"""Sample size from which the mean is taken to be normal, without resampling."""
Flags = npt.NDArray[np.bool_]


class Interval(NamedTuple):
    """An estimate and the range that contains the true value with `CONFIDENCE`."""

    value: float
    low: float
    high: float


def rate(flags: Array | Flags) -> Interval:
    """Return the share of flags (n,), n > 0, that are set, with Wilson's interval (1927)."""
    low, high = proportion_confint(int(np.sum(flags)), len(flags), 1.0 - CONFIDENCE, method="wilson")
    return Interval(float(np.mean(flags)), float(low), float(high))


def mean(values: Array) -> Interval:
    """Return the mean of values (n,), n > 0, with a bootstrap interval, the same at every call.

    Corrected for bias and skewness (BCa: Efron, J. Am. Stat. Assoc. 82, 1987). Of the differences between two entrants
    in the same cases, it is the paired bootstrap. Values that are all the same have no range but themselves.
    """
    middle = float(np.mean(values))
    if np.ptp(values) <= 1e-12 * max(1.0, np.max(np.abs(values))):  # round-off
        return Interval(middle, middle, middle)
    if len(values) >= _MANY:
        return Interval(middle, *stats.norm.interval(CONFIDENCE, middle, stats.sem(values)))
    range_ = stats.bootstrap(
        (values,), np.mean, n_resamples=_RESAMPLES, confidence_level=CONFIDENCE, rng=0
    ).confidence_interval
    return Interval(middle, float(range_.low), float(range_.high))


def median(values: Array) -> Interval:
    """Return the median of values (n,), n > 0, with its distribution-free interval (sign test).

    Of few values, it reaches from the least to the greatest, and holds less than it should.
    """
    range_ = stats.quantile_test(values, q=np.median(values), p=0.5).confidence_interval(CONFIDENCE)
    low, high = np.nan_to_num(range_.low, nan=np.min(values)), np.nan_to_num(range_.high, nan=np.max(values))
    return Interval(float(np.median(values)), float(low), float(high))


class Duel(NamedTuple):
    """Two entrants in the same cases."""

    only_first: int
    """Number of cases in which the first entrant succeeds and the second does not."""
    only_second: int
    p: float
    """Probability of a difference of at least this size if there were none: McNemar's exact test (1947)."""

    @property
    def decided(self) -> bool:
        """Return True if chance is a poor explanation of the difference."""
        return self.p < 1.0 - CONFIDENCE


def duel(first: Flags, second: Flags) -> Duel:
    """Compare successes (n,) of two entrants case by case."""
    won, lost = int(np.sum(first & ~second)), int(np.sum(second & ~first))
    return Duel(won, lost, float(mcnemar([[0, won], [lost, 0]], exact=True).pvalue))


def ranks(success: Flags, error: Array, names: Sequence[str]) -> dict[str, int]:
    """Rank entrants by number of successes.

    Entrants that McNemar's test cannot separate from the first of a rank share the rank.

    Each is tested against the first of the rank above alone, not against all: the order has no cycles, and the tests,
    one an entrant, are not corrected for their number.

    Args:
        success: (cases, entrants).
        error: (cases, entrants) by the mean of which, to 1e-4, those are put in order that succeed equally often.
        names: (entrants,).

    Returns:
        In the order of the ranking; 1 is best.
    """
    won, missed = success.sum(axis=0), error.mean(axis=0)
    order = sorted(range(len(names)), key=lambda i: (-won[i], round(float(missed[i]), 4)))
    result: dict[str, int] = {}
    leader, rank = order[0] if order else 0, 1
    for place, i in enumerate(order, 1):
        if duel(success[:, leader], success[:, i]).decided:
            leader, rank = i, place
        result[names[i]] = rank
    return result


def pareto(x: Array, y: Array) -> Flags:
    """Return for each point (n,) whether no other one has smaller x and larger y.

    Of two points with one coordinate equal, the other coordinate decides.
    """
    no_worse = (x[None, :] <= x[:, None]) & (y[None, :] >= y[:, None])
    better = (x[None, :] < x[:, None]) | (y[None, :] > y[:, None])
    return np.asarray(~np.any(no_worse & better, axis=1))
