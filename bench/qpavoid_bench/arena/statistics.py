"""Statistics of a sample of runs: intervals, paired tests, ranks, Pareto fronts."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr, ndtr, ndtri, stdtrit
from scipy.stats import binom

from qpavoid.problem import Array

CONFIDENCE = 0.95
"""Confidence of all intervals and tests."""
_Z = float(ndtri(0.5 + 0.5 * CONFIDENCE))
_RESAMPLES = 2000
_MANY = 3000
"""Sample size from which the mean is taken to be normal, without resampling."""
Flags = npt.NDArray[np.bool_]


class Interval(NamedTuple):
    """An estimate and the range that contains the true value with `CONFIDENCE`."""

    value: float
    low: float
    high: float


def rate(successes: int, trials: int) -> Interval:
    """Return the success rate with Wilson's interval (1927), within 0 and 1 and never empty.

    Raises:
        ValueError: no trials.
    """
    if trials < 1:
        raise ValueError("no trials: there is no rate")
    z2 = _Z**2
    p = successes / trials
    middle = (p + z2 / (2 * trials)) / (1.0 + z2 / trials)
    half = np.sqrt(z2 * (p * (1.0 - p) + z2 / (4 * trials)) / trials) / (1.0 + z2 / trials)
    return Interval(p, max(0.0, middle - half), min(1.0, middle + half))


def mean(values: Array) -> Interval:
    """Return the mean of values (n,) with a bootstrap interval, the same at every call.

    Percentiles of the means of resamples, as far out as Student's t asks for, so that few values give a range that is
    wide enough (the expanded percentile interval: Hesterberg, The American Statistician 69, 2015). Of the differences
    between two entrants in the same cases, it is the paired bootstrap. One value has no range but itself.

    Raises:
        ValueError: no values.
    """
    count = len(values)
    if count < 1:
        raise ValueError("no values: there is no mean")
    middle = float(np.mean(values))
    if count == 1:
        return Interval(middle, middle, middle)
    if count >= _MANY:
        half = _Z * float(np.std(values, ddof=1)) / float(np.sqrt(count))
        return Interval(middle, middle - half, middle + half)
    half_width = float(stdtrit(count - 1, 0.5 + 0.5 * CONFIDENCE) * np.sqrt(count / (count - 1)))
    low, high = np.quantile(_resamples(count) @ values, [ndtr(-half_width), ndtr(half_width)])
    return Interval(middle, min(float(low), middle), max(float(high), middle))  # round-off, where all are the same


@lru_cache(maxsize=8)
def _resamples(count: int) -> Array:
    """Return weights (resamples, count) of values in means of bootstrap samples."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES) / count


def median(values: Array) -> Interval:
    """Return the median of values (n,) with its distribution-free interval (sign test).

    By signs: the number of values below the median is binomial (Conover, Practical Nonparametric Statistics, 3.2). Of
    fewer than six values, it reaches from the least to the greatest, and holds less than it should.

    Raises:
        ValueError: no values.
    """
    count = len(values)
    if count < 1:
        raise ValueError("no values: there is no median")
    outer = max(int(binom.ppf(0.5 - 0.5 * CONFIDENCE, count, 0.5)) - 1, 0)
    ordered = np.sort(values)
    return Interval(float(np.median(values)), float(ordered[outer]), float(ordered[count - 1 - outer]))


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
    return Duel(won, lost, min(1.0, 2.0 * float(bdtr(min(won, lost), won + lost, 0.5))))


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
    found: dict[str, int] = {}
    leader, rank = order[0] if order else 0, 1
    for place, i in enumerate(order, 1):
        if duel(success[:, leader], success[:, i]).decided:
            leader, rank = i, place
        found[names[i]] = rank
    return found


def pareto(x: Array, y: Array) -> Flags:
    """Return for each point (n,) whether no other one has smaller x and larger y.

    Of two points with one coordinate equal, the other coordinate decides.
    """
    no_worse = (x[None, :] <= x[:, None]) & (y[None, :] >= y[:, None])
    better = (x[None, :] < x[:, None]) | (y[None, :] > y[:, None])
    return np.asarray(~np.any(no_worse & better, axis=1))
