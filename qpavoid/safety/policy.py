"""Data of backup trajectories: where one begins, its policy, the velocities, and how good it is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.control.estimates import ObstacleEstimates
from qpavoid.problem import Array, Mask

TOUCH = 1e-3
"""Distance below which a pair counts as in contact [m]: above the error of any distance algorithm in use."""


class BackupPolicy(NamedTuple):
    """Rule by which a backup trajectory keeps away from everything."""

    horizon: float
    """h [s]; 0 brakes to a standstill."""
    bias_velocity: Array
    """v̂ (nv,) [rad/s, m/s]."""


class Near(NamedTuple):
    """Enabled pairs within the influence distance; in memory that the next evaluation overwrites."""

    closest: Array
    """(k, 10) distances first [m]."""
    J: Array
    """(k, nv) velocity Jacobian of these distances."""
    feedforward: Array
    """(k,) their rate due to the obstacles [m/s]."""


class Start(NamedTuple):
    """State in which a backup trajectory begins."""

    q: Array
    """(nq,)."""
    v: Array
    """(nv,) velocity of the control step before."""
    dv: Array
    """(nv,) change of velocity in that step."""
    t: float
    """[s]."""
    enabled: Mask
    """(m,) pairs that may not come into contact."""


class BackupScore(NamedTuple):
    """Quality of a backup trajectory, the larger the better, compared field by field."""

    time_to_contact: float
    """The horizon, less what is left of it at the first contact of each pair that comes into contact [s].

    Contacts add up: one that no trajectory avoids is no reason to accept a second one.
    """
    clearance: float
    """Least distance of the pairs without contact, capped at the one that suffices [m]."""


class BackupTrajectory(NamedTuple):
    """Velocities of successive control steps, and what is known of where they lead."""

    start: Start
    v: Array
    """(k, nv) of each control step."""
    policy: BackupPolicy
    score: BackupScore
    contact_time: float
    """Time of the first contact; without one, the end [s]."""
    clearance: float
    """Least distance of the pairs without contact, at most the influence distance [m]."""
    estimates: ObstacleEstimates | None
    """Of the external obstacles, as the trajectory was computed."""


class ContactAccumulator:
    """Contacts along a backup trajectory, summed up as it is computed."""

    def __init__(self, start: Start, horizon: float) -> None:
        """Begin without any contact.

        Args:
            start: of the trajectory.
            horizon: time after the start from which on a contact costs nothing [s].
        """
        self.enabled, self.contact_time, self.clearance = start.enabled.copy(), np.inf, np.inf
        self.lost_time, self._clearance_before, self._deadline = 0.0, np.inf, start.t + horizon

    def add(self, distances: tuple[int, float, float], t: float, span: float) -> None:
        """Add the distances of one pose; contacts are dated by interpolation between two poses.

        Args:
            distances: pairs in contact, least distance with and without these [m]; see `kernels.backup_rows`.
            t: time of the pose [s].
            span: time since the pose before [s].
        """
        contacts, nearest, nearest_apart = distances
        if contacts:
            closing = self._clearance_before - nearest
            time = t - span * (TOUCH - nearest) / closing if 0.0 < closing < np.inf else t
            self.contact_time = min(self.contact_time, time)
            self.lost_time += contacts * max(self._deadline - time, 0.0)
        self.clearance, self._clearance_before = min(self.clearance, nearest_apart), nearest_apart
