"""What a program tells of obstacles, as far as the future follows from it."""

from __future__ import annotations

from math import nan

import numpy as np

from qpavoid import kernels
from qpavoid.control.inputs import FASTEST
from qpavoid.kernels.estimates import FIT
from qpavoid.model.sample import STATE, Sample
from qpavoid.problem import Array, IntArray

_STEADY = 0.2
"""Time over which twists are averaged [s]."""
_SHORTEST = 1e-3
"""Part of a control period below which two poses count as of the same time, so that no twist follows from them."""
_LONGEST = 1e3
"""Time for which an obstacle keeps its last twist at the most [s]: by then it is out of every scene."""


class MeasuredStates:
    """The last update of every obstacle that a program gives, and the mean of its twists: memory of the tracker.

    The twist of a single measurement is no base for what an obstacle does in a second; the mean is.
    """

    def __init__(self, count: int, dt: float) -> None:
        """Lay out memory for `count` obstacles; dt is the control period [s]."""
        self._shortest = _SHORTEST * dt
        self.twists, self._counts = np.zeros((count, 6)), np.zeros(count)
        self.stamps = np.full(count, nan)
        """(o,) time stamps of the last updates [s], NaN where there is none."""
        self.at_rest = np.zeros(count, dtype=bool)
        """(o,) whether these were at rest."""
        self.states = np.zeros((count, STATE))
        """(o, 18) the last updates, at their time stamps."""
        self._fits = np.zeros((count, FIT))
        self.updates = np.zeros((count, STATE))
        """(o, 18) what the step is given, before it is taken over."""
        self.known: dict[int, None] = {}
        """Numbers of the obstacles that are given, in the order in which they first were."""

    def forget(self, index: int) -> None:
        """Drop what is known of obstacle number `index`."""
        self.known.pop(index, None)
        self.stamps[index], self.at_rest[index] = nan, False
        self._counts[index], self.twists[index], self._fits[index] = 0.0, 0.0, 0.0

    def begin(self, index: int, t: float, sample: Sample) -> None:
        """Take a sample as what is known of obstacle number `index` at t [s]."""
        self.states[index] = sample.row
        self.known[index], self.stamps[index] = None, t

    def update(self, which: IntArray, kind: IntArray, stamps: Array, states: Array) -> int:
        """Take over `updates` of some obstacles; see `kernels.update_estimates`.

        Args:
            which: their numbers (k,).
            kind: SAMPLE, POSE or REST (k,).
            stamps: their time stamps (k,) [s].
            states: out: rows `which` (o, 18).

        Returns:
            How many were not taken over.
        """
        return int(
            kernels.update_estimates(
                which, kind, stamps, self.updates, self.stamps, self.states, states,
                self._fits, self._shortest, FASTEST, _STEADY, self.twists, self._counts, self.at_rest,
            )
        )  # fmt: skip

    def extrapolate(self, which: IntArray, t: float, stale_after: float, states: Array, margin: Array) -> int:
        """Write where some obstacles are at t [s], and margins of stale ones; see `kernels.extrapolate_estimates`.

        Returns:
            How many are stale.
        """
        return int(
            kernels.extrapolate_estimates(
                which, t, _LONGEST, self.stamps, self.states, states, stale_after, self.at_rest, margin
            )
        )
