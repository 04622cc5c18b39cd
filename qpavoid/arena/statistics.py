"""What a sample of runs allows to say: intervals, tests over the same cases, ranks, Pareto fronts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, norm

from qpavoid.problem import Array

CONFIDENCE = 0.95
"""Of all intervals and tests."""
_RESAMPLES = 1000
_MANY = 3000
"""Sample size from which the mean is taken to be normal, and nothing is resampled."""
Flags = npt.NDArray[np.bool_]


class Interval(NamedTuple):
    """An estimate and the range that holds the true value with `CONFIDENCE`."""

    value: float
    low: float
    high: float


def rate(successes: int, trials: int) -> Interval:
    """Share of successes with the interval of Wilson (1927), which keeps within 0 and 1 and never has no width.

    Raises:
        ValueError: no trials.
    """
    if trials < 1:
        raise ValueError("no trials: there is no rate")
    z2 = float(norm.ppf(0.5 + 0.5 * CONFIDENCE)) ** 2
    p = successes / trials
    middle = (p + z2 / (2 * trials)) / (1.0 + z2 / trials)
    half = np.sqrt(z2 * (p * (1.0 - p) + z2 / (4 * trials)) / trials) / (1.0 + z2 / trials)
    return Interval(p, max(0.0, middle - half), min(1.0, middle + half))


def mean(values: Array) -> Interval:
    """Mean of values (n,) with its percentile bootstrap interval (Efron 1979); the same at every call.

    Raises:
        ValueError: no values.
    """
    count = len(values)
    if count < 1:
        raise ValueError("no values: there is no mean")
    middle = float(np.mean(values))
    tail = 0.5 - 0.5 * CONFIDENCE
    if count >= _MANY:
        half = float(norm.ppf(1.0 - tail) * np.std(values, ddof=1) / np.sqrt(count))
        return Interval(middle, middle - half, middle + half)
    weights = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES)
    low, high = np.quantile(weights @ values / count, [tail, 1.0 - tail])
    return Interval(middle, float(low), float(high))


class Duel(NamedTuple):
    """Two entrants in the same cases."""

    only_first: int
    """Cases in which the first one succeeds and the second does not."""
    only_second: int
    p: float
    """Probability of a difference of at least this size if there were none: McNemar's exact test (1947)."""

    @property
    def decided(self) -> bool:
        """Whether chance is a poor explanation."""
        return self.p < 1.0 - CONFIDENCE


def duel(first: Flags, second: Flags) -> Duel:
    """Compares successes (n,) case by case."""
    won, lost = int(np.sum(first & ~second)), int(np.sum(second & ~first))
    p = float(binomtest(won, won + lost).pvalue) if won + lost else 1.0
    return Duel(won, lost, p)


def ranks(success: Flags, names: Sequence[str]) -> dict[str, int]:
    """Rank by name, by number of successes; whoever cannot be told from the first of a rank shares it.

    Args:
        success: (cases, entrants).
        names: of the entrants.

    Returns:
        In the order of the ranking; 1 is best.
    """
    order = sorted(range(len(names)), key=lambda i: (-int(success[:, i].sum()), names[i]))
    found: dict[str, int] = {}
    leader, rank = order[0] if order else 0, 1
    for place, i in enumerate(order, 1):
        if duel(success[:, leader], success[:, i]).decided:
            leader, rank = i, place
        found[names[i]] = rank
    return found


def pareto(x: Array, y: Array) -> Flags:
    """(n,) whether no other point has both a smaller x and a larger y, one of them at least as good and one better."""
    no_worse = (x[None, :] <= x[:, None]) & (y[None, :] >= y[:, None])
    better = (x[None, :] < x[:, None]) | (y[None, :] > y[:, None])
    return np.asarray(~np.any(no_worse & better, axis=1))
