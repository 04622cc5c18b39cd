"""What a program tells of obstacles, as far as the future follows from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.obstacles.courses import move_on
from qpavoid.problem import Array, IntArray

_STEADY = 0.2
"""Time over which twists are averaged [s]."""
_ROTATION, _POSITION, _LINEAR, _ANGULAR = slice(9), slice(9, 12), slice(12, 15), slice(15, 18)
"""Where the parts of a state are."""


class Told(NamedTuple):
    """What is known of some obstacles."""

    which: tuple[int, ...]
    """Their numbers."""
    states: Array
    """(k, 18) see `courses`; with mean twists."""
    t: float
    """When [s]."""


class MeanTwists:
    """Means of the twists that were given lately: what a sensor says once tells little of what will be in a second."""

    def __init__(self, count: int) -> None:
        self.twists, self._counts = np.zeros((count, 6)), np.zeros(count)

    def add(self, which: IntArray, elapsed: Array, states: Array) -> None:
        """Take in the twists of some obstacles: the mean is of all at first, then of the last ones.

        Args:
            which: numbers of the obstacles (k,).
            elapsed: time since each was given last (k,), NaN where it never was [s].
            states: of all obstacles (o, 18).
        """
        self._counts[which] += 1.0
        elapsed = np.maximum(elapsed, 0.0)
        share = np.fmax(1.0 / self._counts[which], elapsed / (_STEADY + elapsed))[:, None]
        self.twists[which] += share * (states[which, 12:] - self.twists[which])

    def forget(self, index: int) -> None:
        """Drop what is known of obstacle number `index`."""
        self._counts[index], self.twists[index] = 0.0, 0.0


def strayed(now: Told | None, before: Told | None, span: float, reach: Array) -> float:
    """How far any point of an obstacle is off from where it was foreseen to be, now and for some time [m].

    Positions and rotations that are off by δp and δR, and twists by δv and δω, leave a point that is r from the
    origin no farther off than |δp| + t |δv| + r (‖δR‖ + t |δω|) after t.

    Args:
        now: what is told.
        before: what was told when it was foreseen.
        span: for how long it counts [s].
        reach: distance from each obstacle's origin to its farthest point (o,) [m].

    Returns:
        Infinity, where it is not of the same obstacles.
    """
    if now is None or before is None or now.which != before.which:
        return 0.0 if now is before else np.inf
    expected = before.states.copy()
    move_on(expected, now.t - before.t)
    off = np.abs(now.states - expected)
    if not off.any():
        return 0.0
    p, v, R, w = (np.linalg.norm(off[:, part], axis=1) for part in (_POSITION, _LINEAR, _ROTATION, _ANGULAR))
    turned = R + span * w
    radii = np.where(turned > 0.0, reach[list(now.which)], 0.0)  # half-spaces have no end
    return float(np.max(p + span * v + radii * turned))
