"""What a flight is: where it begins, how it flees, where it leads, and what that is worth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.control.estimates import ObstacleEstimates
from qpavoid.problem import Array, Mask

TOUCH = 1e-3
"""Distance below which a pair counts as touching [m]."""


class BackupPolicy(NamedTuple):
    """A way to flee."""

    horizon: float
    """h [s]; 0 stands still."""
    leaning: Array
    """v̂ (nv,) [rad/s, m/s]."""


class Near(NamedTuple):
    """What a flight looks at: the watched pairs within reach; in memory that the next look overwrites."""

    closest: Array
    """(k, 10) distances first [m]."""
    J: Array
    """(k, nv) velocity Jacobian of these distances."""
    feedforward: Array
    """(k,) their rate due to the obstacles [m/s]."""


class Start(NamedTuple):
    """Where a flight begins."""

    q: Array
    """(nq,)."""
    v: Array
    """(nv,) velocity that has led there."""
    w: Array
    """(nv,) by how much that changed in the tick before."""
    t: float
    """[s]."""
    watched: Mask
    """(m,) pairs that are not to touch."""


class Value(NamedTuple):
    """How good a flight is, the larger the better."""

    clear: float
    """The horizon of the foresight, less what is left of it, for each pair that touches, when that first does [s].

    Of a pair that touches in every flight, nothing more is lost by keeping the others apart.
    """
    distance: float
    """Smallest distance of pairs that do not touch, up to what counts as safe [m]."""


class Flight(NamedTuple):
    """Velocities, and where they lead."""

    start: Start
    v: Array
    """(k, nv) of each tick."""
    manner: BackupPolicy
    value: Value
    until: float
    """When something touches; the end, if nothing does before [s]."""
    least: float
    """Smallest distance of pairs that do not touch, up to that at which flights look at pairs [m]."""
    told: ObstacleEstimates | None
    """What was told of obstacles when it was flown."""


class Tally:
    """What touches in the course of a flight."""

    def __init__(self, start: Start, horizon: float) -> None:
        self.watched, self.until, self.least = start.watched.copy(), np.inf, np.inf
        self.lost, self._before, self._deadline = 0.0, np.inf, start.t + horizon

    def count(self, found: tuple[int, float, float], t: float, span: float) -> None:
        """Takes what a look has found, see `backup_rows`, into account; at t, `span` after the last one [s]."""
        touching, nearest, rest = found
        if touching:
            closing = self._before - nearest
            when = t - span * (TOUCH - nearest) / closing if 0.0 < closing < np.inf else t
            self.until = min(self.until, when)
            self.lost += touching * max(self._deadline - when, 0.0)
        self.least, self._before = min(self.least, rest), rest
