"""States of many bodies, as rows of one array: their trajectories sampled together.

A row is the *state* of a body: rotation by columns, position, linear and angular velocity, all in world axes (18,).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from qpavoid import kernels
from qpavoid.kernels import Pieces
from qpavoid.model.sample import STATE
from qpavoid.model.trajectory import Motion, Trajectory
from qpavoid.problem import Array

_NONE = Pieces(np.zeros(0, np.intp), np.zeros(1, np.intp), np.zeros(0), np.zeros((0, 4)), np.zeros((0, 7, STATE)))
"""Trajectories of no bodies."""


def extrapolate(states: Array, t: float | Array) -> None:
    """Bring bodies to where they are some time later at constant twists about their origins, in place.

    Args:
        states: (k, 18).
        t: that time, one for all or (k,) [s].
    """
    kernels.extrapolate_states(states, np.full(len(states), t, dtype=np.float64))


class TrajectoryBatch:
    """The trajectories of some bodies."""

    def __init__(self, motions: Mapping[int, Motion]) -> None:
        """Lays the memory out.

        Args:
            motions: trajectory of each body, by the row of the states that it has.
        """
        known = {body: motion.pieces for body, motion in motions.items() if type(motion) is Trajectory}
        self.others = {body: motion for body, motion in motions.items() if body not in known}
        """Those of other classes, even if derived, which have to be sampled one by one."""
        pieces = [_NONE, *known.values()]
        counts = [len(each.starts) for each in known.values()]
        self.pieces = Pieces(
            bodies=np.array(list(known), dtype=np.intp),
            first=np.concatenate(([0], np.cumsum(counts))).astype(np.intp),
            starts=np.concatenate([each.starts for each in pieces]),
            clock=np.concatenate([each.clock for each in pieces]),
            terms=np.concatenate([each.terms for each in pieces]),
        )
        """Those of all bodies but the `others`."""

    def sample(self, t: float, states: Array) -> None:
        """Brings the states (o, 18) of all bodies but the `others` to a finite time t [s]; see `Motion.sample`."""
        kernels.sample_pieces(self.pieces, t, states)
