"""Where obstacles are at the time of a step, as far as arrays tell: memory of the tracker."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan
from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.kernels import Pieces
from qpavoid.kernels.estimates import QUATERNION
from qpavoid.kernels.obstacles import FARTHEST, FASTEST
from qpavoid.kernels.pose_fit import FIT
from qpavoid.kernels.turns import TURN_FIT
from qpavoid.model.sample import POSE, STATE, Sample
from qpavoid.problem import Array, IntArray

_SHORTEST = 1e-3
"""Part of a control period below which two poses count as of the same time, so that no twist follows from them."""
_NONE, _NO_STAMPS = np.zeros(0, dtype=np.intp), np.zeros(0)


class MeasuredStates:
    """States of all obstacles, the last updates of those that a program gives, and the means of their twists.

    The twist of a single measurement is no base for what an obstacle does in a second; the mean is.
    """

    def __init__(self, pieces: Pieces, count: int, dt: float, stale_after: float = inf) -> None:
        """Lay out memory, and load all kernels.

        Args:
            pieces: trajectories of those of `count` obstacles that follow one.
            count: number of obstacles.
            dt: control period [s].
            stale_after: age from which one is stale [s].
        """
        self.arrays = kernels.ObstacleArrays(
            pieces=pieces,
            uncertainty=np.zeros(count),
            margin=np.zeros(count),
            states=np.zeros((count, STATE)),
            updates=np.zeros((count, STATE)),
            codes=np.zeros(count, dtype=np.intp),
            deviation=np.zeros(count),
            stamps=np.full(count, nan),
            last=np.zeros((count, STATE)),
            at_rest=np.zeros(count, dtype=bool),
            means=np.zeros((count, 6)),
            twists=np.zeros((count, 6)),
            turns=np.zeros((count, 3)),
            turn_fits=np.zeros((count, TURN_FIT)),
            counts=np.zeros(count),
            fits=np.zeros((count, FIT)),
            displacement=np.zeros(6),
            line=np.zeros((2, 6)),
            shortest=_SHORTEST * dt,
            stale_after=stale_after,
            max_position=FARTHEST,
            max_speed=FASTEST,
        )
        self.packed = kernels.pack(self.arrays)
        """The same memory, in the form that kernels take."""
        self._follow: Callable[..., bool] = kernels.follow_trajectories
        self.known: dict[int, None] = {}
        """Numbers of the obstacles that are given, in the order in which they first were."""
        for columns in (STATE, POSE, QUATERNION):  # the same code
            rows = np.zeros((0, columns))
            self._check = kernels.direct(kernels.check_updates, self.packed, _NONE, rows, _NONE)
        self._observe = kernels.direct(kernels.observe, self.packed, 0.0, _NONE, _NONE, _NO_STAMPS, _NONE)

    def follow_trajectories(self, t: float, which: IntArray, distances: Any) -> bool:
        """Bring all obstacles to t [s], and place some (k,); see `kernels.follow_trajectories`."""
        return bool(self._follow(self.packed, distances, t, which))

    def load(self, distances: Any) -> None:
        """Load the code of `follow_trajectories`: no control step waits for it."""
        self._follow = kernels.direct(kernels.follow_trajectories, self.packed, distances, 0.0, _NONE)

    def follow(self, pieces: Pieces) -> None:
        """Let obstacles follow other trajectories."""
        self.arrays = self.arrays._replace(pieces=pieces)
        self.packed = kernels.pack(self.arrays)

    def forget(self, index: int) -> None:
        """Drop what is known of obstacle number `index`."""
        x = self.arrays
        self.known.pop(index, None)
        x.stamps[index], x.at_rest[index] = nan, False
        for memory in (x.counts, x.fits, x.means, x.twists, x.turns, x.turn_fits):
            memory[index] = 0.0

    def begin(self, index: int, t: float, sample: Sample) -> None:
        """Take a sample as what is known of obstacle number `index` at t [s]."""
        self.arrays.last[index] = sample.row
        self.known[index], self.arrays.stamps[index] = None, t

    def check(self, which: IntArray, rows: Array, kind: IntArray) -> int:
        """Write what a step is given into `updates`, and check it; see `kernels.check_updates`.

        Args:
            which: numbers of the obstacles (k,).
            rows: (k, 18), (k, 12) or (k, 7), in one piece.
            kind: SAMPLE, POSE or REST (k,).
        """
        return int(self._check(self.packed, which, rows, kind))

    def observe(self, t: float, which: IntArray, kind: IntArray, stamps: Array, external: IntArray) -> tuple[int, int]:
        """Take over `updates` of some obstacles, and bring all to t [s]; see `kernels.observe`.

        Args:
            t: time [s].
            which: numbers of those that are updated (k,).
            kind: SAMPLE, POSE or REST (k,).
            stamps: their time stamps (k,) [s].
            external: numbers of all that are known (e,).

        Returns:
            How many updates were not taken over; how many obstacles are stale.
        """
        counts: tuple[int, int] = self._observe(self.packed, t, which, kind, stamps, external)
        return counts
