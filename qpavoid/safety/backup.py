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
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray, Proximity
from qpavoid.safety.policy import TOUCH, BackupPolicy, BackupScore, BackupTrajectory, Start
from qpavoid.safety.rollout import BackupRollouts

_HORIZONS = (0.2, 0.05, 0.5)
"""h of backup policies [s]: the most successful first."""
_UNBIASED_FRACTION = 0.25
"""Fraction of the sampled policies without a bias velocity [-]."""
_BIAS_SPEEDS = (2.0, 30.0)
"""Range of ‖v̂‖ of the others, log-uniform [rad/s, m/s]: from a tie-break to full speed."""
_DECISION_TIME = 0.01
"""Least time for which a decision holds [s]: rollouts take longer than a control step of a millisecond."""
_SPHERE_PERIOD = 0.1
"""Time between two positions of the bounding spheres of moving obstacles [s]."""
_DISTANCE_TOLERANCE = 1e-6
"""Difference of two clearances that counts as none [m]."""


class _SampledPaths(NamedTuple):
    """Positions of the moving obstacles, every `_SPHERE_PERIOD` until the horizon."""

    first: int | None
    """Multiple of that period at which they begin; None before the first evaluation."""
    moving: IntArray
    """(k,) numbers of the obstacles that move until then."""
    positions: Array
    """(t, k, 3) [m]."""
    max_deviation: Array
    """(k,) largest distance from the nearest of these positions in between [m]."""
    max_speed: float
    """Largest speed of any of their points [m/s]."""


_NO_PATHS = _SampledPaths(None, np.zeros(0, np.intp), np.zeros((0, 0, 3)), np.zeros(0), 0.0)


class _CachedClearance(NamedTuple):
    """Clearance between the paths of moving obstacles and a robot at rest, beyond the preferred distance."""

    paths: _SampledPaths
    """Of the obstacles."""
    q: Array
    """(nq,) of the robot."""
    clearance: float
    """[m]."""


class BackupPlanner:
    """Decides between the velocity of the solver and the first one of a backup trajectory."""

    def __init__(
        self, rollouts: BackupRollouts, scene: Scene, bounds: JointBounds, obstacles: ObstacleTracker, dt: float
    ) -> None:
        """Begin without a backup trajectory.

        Args:
            rollouts: computes backup trajectories.
            scene: robot and obstacles.
            bounds: limits of the joints.
            obstacles: states of the obstacles.
            dt: control period [s].
        """
        self.rollouts, self._settings = rollouts, rollouts.settings
        self._model, self._obstacles, self._dt = scene.robot.model, obstacles, dt
        self._braking = 0.5 / bounds.acceleration
        self._hold_steps = int(np.ceil(_DECISION_TIME / dt - 1e-9)) - 1
        """Control steps for which a decision holds after its own."""
        self.reset()

    def reset(self) -> None:
        """Drop the backup trajectory, and restart the random sequence."""
        self._backup: BackupTrajectory | None = None
        self._wait = 0
        self._random, self._straight_policies = np.random.default_rng(0), list[float]()
        self._cached_clearance: _CachedClearance | None = None
        self._paths = _NO_PATHS

    def invalidate(self) -> None:
        """Take in that attached objects or disabled pairs have changed, and require a new verification."""
        self.rollouts.invalidate()
        self._paths, self._cached_clearance = _NO_PATHS, None
        if self._backup is not None:
            self._backup = self._backup._replace(contact_time=-np.inf)

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
        if not self._obstacles.any_may_move:
            self._backup = None
            return None
        enabled = self.rollouts.separable_pairs
        next_state = Start(pin.integrate(self._model, q, self._dt * v), v, v - v_prev, t + self._dt, enabled)
        if self._moving_obstacles_stay_far(next_state):
            self._backup = None
            return None
        touching = proximity.pair[proximity.distance < TOUCH]
        if len(touching):
            enabled = enabled.copy()
            enabled[touching] = False
            next_state = next_state._replace(enabled=enabled)
        command, backup = v, self._backup
        if backup is not None and len(backup.v):
            remainder = self.rollouts.advance(backup)
            if not self.rollouts.is_valid_from(remainder, next_state, self._paths.max_speed):
                command = backup.v[0]
            if command is v or (self._wait and abs(backup.start.t - t) <= self._dt):
                self._backup, self._wait = remainder, max(self._wait - 1, 0)
                return None if np.array_equal(command, v) else command
        self._wait = self._hold_steps
        return self._decide(next_state, Start(q, v_prev.copy(), dv_prev.copy(), t, enabled))

    def _decide(self, next_state: Start, state: Start) -> Array | None:
        """Compare trajectories from the next state with those from the present one.

        Returns:
            None if one from the next state is sufficient, or not worse than any from the present one; else the first
            velocity (nv,) of the best from the present one.
        """
        v = next_state.v
        best = self._best(next_state, self._candidates(v))
        if best.score < self.rollouts.sufficient_score:
            backup, trials = self._current_backup(state)
            best = self._best(next_state, ((self._sample_policy(), self._hold(v)) for _ in range(trials)), best)
            if not self._not_worse(best.score, backup.score) and len(backup.v):
                self._backup = self.rollouts.advance(backup)
                return None if np.array_equal(backup.v[0], v) else backup.v[0]
        self._backup = best
        if best.score >= self.rollouts.sufficient_score:
            self._straight_policies = list(_HORIZONS)
        return None

    def _moving_obstacles_stay_far(self, start: Start) -> bool:
        """Return whether bounding spheres prove that moving obstacles stay away from a robot that brakes from `start`.

        Between their sampled positions, obstacles are taken to be no faster than at these. A clearance counts until the
        next sample, less the motion of the robot since.
        """
        paths, stop = (
            self._sample_paths(int(np.floor(start.t / _SPHERE_PERIOD))),
            float(np.square(start.v) @ self._braking),
        )
        if not len(paths.moving):
            return True
        cached = self._cached_clearance
        if cached is not None and cached.paths is paths:
            moved = float(np.abs(pin.difference(self._model, cached.q, start.q)).sum())
            if self.rollouts.lever_arm * (moved + stop) < cached.clearance:
                return True
        self.rollouts.kinematics.compute(start.q)
        centers, radii = self.rollouts.query.body_spheres(self.rollouts.kinematics.joint_poses)
        obstacle_radii = self.rollouts.query.obstacle_radii[paths.moving] + paths.max_deviation
        obstacle_radii = obstacle_radii + self._settings.preferred_distance
        clearance = kernels.min_sphere_distance(paths.positions, centers, obstacle_radii[:, None] + radii)
        self._cached_clearance = _CachedClearance(paths, start.q, clearance)
        return (self.rollouts.lever_arm * stop if stop else 0.0) < clearance

    def _sample_paths(self, first: int) -> _SampledPaths:
        """Sample the positions of moving obstacles from a multiple of `_SPHERE_PERIOD` until the horizon."""
        if first != self._paths.first or self._obstacles.estimates is not None:
            count = int(np.ceil(self._settings.horizon / _SPHERE_PERIOD)) + 2
            times = _SPHERE_PERIOD * np.arange(first, first + count, dtype=np.float64)
            positions, rates = self._obstacles.paths(times)
            moves = np.flatnonzero(rates.any(axis=1) | (positions != positions[0]).any(axis=(0, 2)))
            moving = self._obstacles.moving[moves]
            speed, spin = rates[moves].T
            # half-spaces have no end: of one that does not turn, 0 · ∞ counts as 0
            radii, rim_speed = self.rollouts.query.obstacle_radii[moving], np.zeros_like(spin)
            np.multiply(spin, radii, out=rim_speed, where=spin > 0.0)
            max_speed = float(np.max(speed + rim_speed, initial=0.0))
            max_deviation = 0.5 * _SPHERE_PERIOD * speed
            self._paths = _SampledPaths(first, moving, positions[:, moves].copy(), max_deviation, max_speed)
        return self._paths

    def _candidates(self, v: Array) -> Iterator[tuple[BackupPolicy, Array]]:
        """Yield policies and velocity prefixes: those of the backup trajectory, and a stop."""
        prefix = self._hold(v)
        if self._backup is not None and len(self._backup.v):
            policy, remainder = self._backup.policy, self._backup.v[1:]
            yield policy, prefix
            yield policy, np.concatenate((prefix, remainder[len(prefix) :]))
        yield self.rollouts.stop_policy, prefix

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
        if best is None or best.score < self.rollouts.sufficient_score:
            for policy, prefix in candidates:
                best = self.rollouts.rollout(start, policy, prefix, best) or best
                if best is not None and best.score >= self.rollouts.sufficient_score:
                    break
        assert best is not None
        return best

    def _not_worse(self, later: BackupScore, now: BackupScore) -> bool:
        """Return whether a trajectory that begins in the next control step is not worse than one that begins now.

        Contact times are resolved to one period.
        """
        if later.time_to_contact > now.time_to_contact + self.rollouts.period:
            return True
        return (
            later.time_to_contact + self._dt >= now.time_to_contact
            and later.clearance >= now.clearance - _DISTANCE_TOLERANCE
        )

    def _current_backup(self, start: Start) -> tuple[BackupTrajectory, int]:
        """Return the backup trajectory, verified from `start`, or a better one; and the number of unused trials."""
        backup, trials = self._backup, self._settings.candidates
        if backup is not None and self.rollouts.is_valid_from(backup, start, self._paths.max_speed):
            return backup._replace(start=start), trials
        policy, prefix = (self.rollouts.stop_policy, None) if backup is None else (backup.policy, backup.v)
        best = self.rollouts.simulate(start, policy, prefix)
        while trials and best.score < self.rollouts.sufficient_score:
            trials -= 1
            k = self.rollouts.decision_before(start, int(self._random.integers(len(best.v) + 1))) if trials % 2 else 0
            best = self.rollouts.rollout(start, self._sample_policy(), best.v[:k], best) or best
        return best, trials

    def _sample_policy(self) -> BackupPolicy:
        """Sample a policy: each unbiased horizon once, then random ones."""
        unbiased = self.rollouts.stop_policy.bias_velocity
        if self._straight_policies:
            return BackupPolicy(self._straight_policies.pop(0), unbiased)
        random = self._random
        h = _HORIZONS[random.integers(len(_HORIZONS))]
        if random.random() < _UNBIASED_FRACTION:
            return BackupPolicy(h, unbiased)
        direction, speed = random.normal(size=self._model.nv), np.exp(random.uniform(*np.log(_BIAS_SPEEDS)))
        return BackupPolicy(h, speed / np.linalg.norm(direction) * direction)
