"""Gatekeeper: follows the tasks only while a backup trajectory from the next state stays clear of moving obstacles.

A solver that uses the distances and velocities of one control step can be trapped by obstacles that close in from
several sides: when rows first bind, it is too late. So before a velocity is commanded, backup trajectories are computed
from the state that it leads to: the robot drops its tasks and keeps away from everything, for a second or two, while
obstacles move as predicted. While one of them stays clear, the velocity may be commanded, and that trajectory is kept.
If none does, the kept trajectory is followed instead: it was verified, and stays clear as long as obstacles move as
predicted. This is the scheme of Agrawal, Chen and Panagou 2023, "gatekeeper: Online safety verification and control for
nonlinear systems in dynamic environments", with rollouts of `qpavoid.safety.rollout` as its backup.

Which policy stays clear is not known beforehand. So many are sampled, a few in every control step, as long as none is
good enough: from the present state, and from states along the kept trajectory, whose beginning may be right though its
end is not. The best trajectory of one control step is computed again in the next one, one step farther, from the state
that the robot has then and with the obstacle states of then.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pinocchio as pin

from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.pair_table import PairTable
from qpavoid.control.settings import ControlSettings
from qpavoid.kernels.rollout import TOUCH
from qpavoid.problem import Array, Proximity
from qpavoid.safety.approach import ApproachCheck
from qpavoid.safety.rollout import BackupPolicy, BackupRollouts, BackupScore, BackupTrajectory, Start

_HORIZONS = (0.2, 0.05, 0.5)
"""h of backup policies [s]: the most successful first."""
_CANDIDATES = 3
"""Sampled trajectories that a control step may try [-]: more find a clear one sooner, at half a millisecond each."""
_UNBIASED_FRACTION = 0.25
"""Fraction of the sampled policies without a bias velocity [-]."""
_BIAS_SPEEDS = (2.0, 30.0)
"""Range of ‖v̂‖ of the others, log-uniform [rad/s, m/s]: from a tie-break to full speed."""
_DECISION_TIME = 0.01
"""Least time for which a decision holds [s]: rollouts take longer than a control step of a millisecond."""
_DISTANCE_TOLERANCE = 1e-6
"""Difference of two clearances that counts as none [m]."""


class BackupPlanner:
    """Decides between the velocity of the solver and the first one of a backup trajectory."""

    def __init__(self, settings: ControlSettings, table: PairTable, obstacles: ObstacleTracker) -> None:
        """Begin without a backup trajectory; see `BackupRollouts` for the arguments."""
        self._model, self._obstacles, self._dt = settings.scene.robot.model, obstacles, settings.dt
        self._rollouts = BackupRollouts(settings, table, obstacles)
        self._approach = ApproachCheck(settings, self._rollouts, obstacles)
        self._hold_steps = int(np.ceil(_DECISION_TIME / settings.dt - 1e-9)) - 1
        """Control steps for which a decision holds after its own."""
        self.reset()

    def reset(self) -> None:
        """Drop the backup trajectory, and restart the random sequence."""
        self._backup: BackupTrajectory | None = None
        self._wait, self._sampled, self._random = 0, 0, np.random.default_rng(0)
        self._approach.reset()

    def check(self, q: Array, v: Array, t: float, v_prev: Array, dv_prev: Array, proximity: Proximity) -> Array | None:
        """Return None if v may be commanded, else the velocity (nv,) to command instead.

        Args:
            q: configuration (nq,).
            v: velocity (nv,) of the solver, after the stop look-ahead.
            t: time [s].
            v_prev: velocity (nv,) commanded in the control step before.
            dv_prev: change of velocity (nv,) in that step.
            proximity: distances of this control step; pairs in contact do not count.
        """
        if not len(self._obstacles.moving):
            self._backup = None
            return None
        if self._approach.is_far(q, v, t):
            self._backup = None
            return None
        enabled = self._rollouts.enabled
        next_state = Start(pin.integrate(self._model, q, self._dt * v), v, v - v_prev, t + self._dt, enabled)
        touching = proximity.pair[proximity.distance < TOUCH]
        if len(touching):
            enabled = enabled.copy()
            enabled[touching] = False
            next_state = next_state._replace(enabled=enabled)
        backup = self._backup
        if backup is not None and len(backup.v):
            remainder = self._rollouts.advance(backup)
            is_valid = self._rollouts.is_valid_from(remainder, next_state, self._approach.max_speed)
            if is_valid or (self._wait and abs(backup.start.t - t) <= self._dt):
                self._backup, self._wait = remainder, max(self._wait - 1, 0)
                return None if is_valid else _unless_equal(backup.v[0], v)
        self._wait = self._hold_steps
        return self._decide(next_state, Start(q, v_prev.copy(), dv_prev.copy(), t, enabled))

    def _decide(self, next_state: Start, state: Start) -> Array | None:
        """Compare trajectories from the next state with those from the present one.

        None if one from the next state is sufficient, or not worse than any from the present one; else the first
        velocity (nv,) of the best from the present one.
        """
        v, sufficient = next_state.v, self._rollouts.sufficient_score
        best = self._best(next_state, self._candidates(v))
        if best.score < sufficient:
            backup, trials = self._current_backup(state)
            best = self._best(next_state, ((self._sample_policy(), self._hold(v)) for _ in range(trials)), best)
            if not self._not_worse(best.score, backup.score) and len(backup.v):
                self._backup = self._rollouts.advance(backup)
                return _unless_equal(backup.v[0], v)
        self._backup = best
        if best.score >= sufficient:
            self._sampled = 0
        return None

    def _candidates(self, v: Array) -> Iterator[tuple[BackupPolicy, Array]]:
        """Yield policies and velocity prefixes: those of the backup trajectory, and a stop."""
        prefix = self._hold(v)
        if self._backup is not None and len(self._backup.v):
            policy, remainder = self._backup.policy, self._backup.v[1:]
            yield policy, prefix
            yield policy, np.concatenate((prefix, remainder[len(prefix) :]))
        yield self._rollouts.stop_policy, prefix

    def _hold(self, v: Array) -> Array:
        """Repeat v (nv,) for the control steps (k, nv) until the next decision."""
        return np.tile(v, (self._hold_steps, 1))

    def _best(
        self,
        start: Start,
        candidates: Iterable[tuple[BackupPolicy, Array | None]],
        best: BackupTrajectory | None = None,
    ) -> BackupTrajectory:
        """Return the first sufficient trajectory, or the best of all; candidates after it are not computed."""
        if best is None or best.score < self._rollouts.sufficient_score:
            for policy, prefix in candidates:
                best = self._rollouts.rollout(start, policy, prefix, best) or best
                if best is not None and best.score >= self._rollouts.sufficient_score:
                    break
        assert best is not None
        return best

    def _not_worse(self, later: BackupScore, now: BackupScore) -> bool:
        """Return whether a trajectory that begins in the next control step is not worse than one that begins now.

        Contact times are resolved to one period.
        """
        if later.time_to_contact > now.time_to_contact + self._rollouts.period:
            return True
        return (
            later.time_to_contact + self._dt >= now.time_to_contact
            and later.clearance >= now.clearance - _DISTANCE_TOLERANCE
        )

    def _current_backup(self, start: Start) -> tuple[BackupTrajectory, int]:
        """Return the backup trajectory, verified from `start`, or a better one; and the number of unused trials."""
        backup, trials, rollouts = self._backup, _CANDIDATES, self._rollouts
        if backup is not None and rollouts.is_valid_from(backup, start, self._approach.max_speed):
            return backup._replace(start=start), trials
        best = self._best(start, [(rollouts.stop_policy, None) if backup is None else (backup.policy, backup.v)])
        while trials and best.score < rollouts.sufficient_score:
            trials -= 1
            k = rollouts.decision_before(start, int(self._random.integers(len(best.v) + 1))) if trials % 2 else 0
            best = rollouts.rollout(start, self._sample_policy(), best.v[:k], best) or best
        return best, trials

    def _sample_policy(self) -> BackupPolicy:
        """Sample a policy: each unbiased horizon once, then random ones."""
        random, unbiased, number = self._random, self._rollouts.stop_policy.bias_velocity, self._sampled
        self._sampled += 1
        if number < len(_HORIZONS):
            return BackupPolicy(_HORIZONS[number], unbiased)
        h = _HORIZONS[random.integers(len(_HORIZONS))]
        if random.random() < _UNBIASED_FRACTION:
            return BackupPolicy(h, unbiased)
        direction, speed = random.normal(size=self._model.nv), np.exp(random.uniform(*np.log(_BIAS_SPEEDS)))
        return BackupPolicy(h, speed / np.linalg.norm(direction) * direction)


def _unless_equal(v: Array, other: Array) -> Array | None:
    return None if np.array_equal(v, other) else v
