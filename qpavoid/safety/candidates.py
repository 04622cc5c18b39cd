"""What candidates for a backup trajectory begin with: what is commanded before them, and policies to try."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from qpavoid.problem import Array
from qpavoid.safety.rollout import LEAST_SCORE, BackupPolicy, BackupScore, BackupTrajectory, Start

DISTANCE_TOLERANCE = 1e-6
"""Difference of two clearances that counts as none [m]."""
_HORIZONS = (0.2, 0.05, 0.5)
"""h of backup policies [s]: the most successful first."""
_SAMPLES = 7
"""Policies among which each horizon comes once without a bias velocity [-]: odd, as two kinds of candidates take
turns."""
_BIAS_SPEEDS = (2.0, 30.0)
"""Range of ‖v̂‖ of the others, log-uniform [rad/s, m/s]: from a tie-break to full speed."""


class Command(NamedTuple):
    """What is commanded in a control step, as far as it is decided."""

    v: Array
    """(nv,)."""
    after: Start
    """State that it leads to."""
    after_task: Start
    """State that the velocity of the solver leads to."""
    is_task: bool
    """Whether it is the velocity of the solver."""

    def to_task(self) -> Command:
        """Return the velocity of the solver as the command."""
        return Command(self.after_task.v, self.after_task, self.after_task, True)


class BackupPolicies:
    """Policies, each horizon without a bias and random ones by turns: the same after every `restart`."""

    def __init__(self, nv: int) -> None:
        """Begin the sequence, of policies for nv joints."""
        self._unbiased = np.zeros(nv)
        self.restart()

    def restart(self) -> None:
        """Begin the sequence again, random numbers included."""
        self.random = np.random.default_rng(0)
        self.begin()

    def begin(self) -> None:
        """Let the policies without a bias come next."""
        self._count = 0

    def sample(self) -> BackupPolicy:
        """Return the next policy."""
        random, number = self.random, self._count % _SAMPLES
        self._count += 1
        if number < len(_HORIZONS):
            return BackupPolicy(_HORIZONS[number], self._unbiased)
        h = _HORIZONS[random.integers(len(_HORIZONS))]
        direction, speed = random.normal(size=len(self._unbiased)), np.exp(random.uniform(*np.log(_BIAS_SPEEDS)))
        return BackupPolicy(h, speed / np.linalg.norm(direction) * direction)


def least_score(backup: BackupTrajectory | None, sufficient: BackupScore, elapsed: float) -> BackupScore:
    """Return what a candidate has to exceed that goes on with the velocity of the solver some time later.

    Args:
        backup: kept trajectory; None without one.
        sufficient: score from which on a trajectory need not be improved.
        elapsed: the time [s].
    """
    if backup is None:
        return LEAST_SCORE
    if backup.score >= sufficient:
        return sufficient._replace(clearance=sufficient.clearance - DISTANCE_TOLERANCE)
    return BackupScore(backup.score.time_to_contact - elapsed, -inf)


def not_worse(later: BackupScore, now: BackupScore, period: float, dt: float) -> bool:
    """Return whether a trajectory that begins in the next control step is not worse than one that begins now.

    Contact times are resolved to one period.

    Args:
        later: score of the one in the next step.
        now: score of the one now.
        period: time between two decisions of a trajectory [s].
        dt: control period [s].
    """
    if later.time_to_contact > now.time_to_contact + period:
        return True
    is_as_late = later.time_to_contact + dt >= now.time_to_contact
    return is_as_late and later.clearance >= now.clearance - DISTANCE_TOLERANCE
