"""Rollouts of backup trajectories: the robot drops its tasks and keeps away from everything.

Obstacles follow their trajectories, or are predicted at constant velocity. In every period a backup trajectory
maximises the smallest distance at a horizon h, to first order:

    max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= c,  lower <= v <= upper

with c the preferred distance. This is greedy, and runs into dead ends; which bias v̂ leads out of one is not known
beforehand (see `qpavoid.safety.backup`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.estimates import ObstacleEstimates, prediction_error_bound
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.pair_table import PairTable
from qpavoid.control.row_layout import lay_out
from qpavoid.control.settings import ControlSettings
from qpavoid.model.kinematics import ForwardKinematics, max_lever_arm
from qpavoid.problem import Array, Mask
from qpavoid.safety.jerk import Ramps

HORIZON = 1.5
"""Time for which a backup trajectory has to stay clear [s]: longer than an arm needs to stop or to step aside."""
_PERIOD = 0.04
"""Time between two decisions of a backup trajectory, about [s]: at 1 m/s, less than half of the preferred distance."""
_INFLUENCE_DISTANCE = 0.3
"""Distance below which a pair counts [m]: what closes in at 1 m/s within the longest policy horizon is seen before."""
PREFERRED_DISTANCE = 0.1
"""c: distance from which on a pair is not parted any farther [m]: the default influence distance of the rows."""
_DISTANCE_SCALE = 0.5
"""Fraction of the safety distance that has to be kept [-]: predictions may be wrong by the other half."""
TOUCH = 1e-3
"""Distance below which a pair counts as in contact [m]: above the error of any distance algorithm in use."""
_EFFORT_WEIGHT = 1e-4
"""ε: weight of the square of a joint speed beside that of a distance [m²/(rad/s)²]; only breaks ties."""
_MAX_DEPTH = 10.0
"""Lower bound of s in the QP [m]: deeper than any penetration."""
_ROUND_OFF = 1e-6
"""Difference of two times that counts as none [s]."""
_BEYOND = 0.1
"""Time by which a rollout exceeds the horizon [s], so that it stays valid for some control steps."""

Near = tuple[Array, Array, Array]
"""Witness points (k, 10), distances first, Jacobians (k, nv) and feed-forward (k,) of the enabled pairs within the
influence distance; in memory that the next evaluation overwrites."""


class BackupPolicy(NamedTuple):
    """Rule by which a backup trajectory keeps away from everything."""

    horizon: float
    """h [s]; 0 brakes to a standstill."""
    bias_velocity: Array
    """v̂ (nv,) [rad/s, m/s]."""


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


class _Contacts:
    """Contacts along a backup trajectory, summed up as it is computed."""

    def __init__(self, start: Start) -> None:
        self.enabled, self.time, self.clearance = start.enabled.copy(), np.inf, np.inf
        self.lost_time, self._clearance_before, self._deadline = 0.0, np.inf, start.t + HORIZON

    def add(self, count: int, nearest: float, nearest_separable: float, t: float, span: float) -> None:
        """Add a pose at t [s], `span` after the one before; contacts are dated by interpolation between the two.

        There, `count` pairs come into contact; the least distance with these, and without, is given [m].
        """
        if count:
            closing = self._clearance_before - nearest
            time = t - span * (TOUCH - nearest) / closing if 0.0 < closing < np.inf else t
            self.time = min(self.time, time)
            self.lost_time += count * max(self._deadline - time, 0.0)
        self.clearance, self._clearance_before = min(self.clearance, nearest_separable), nearest_separable


class BackupRollouts:
    """Computes backup trajectories, on kinematics and distances of its own."""

    def __init__(self, settings: ControlSettings, table: PairTable, obstacles: ObstacleTracker) -> None:
        """Allocate all memory, and compile all kernels."""
        scene, self._dt = settings.scene, settings.dt
        model = self._model = scene.robot.model
        self._obstacles, self._period_steps = obstacles, max(1, int(np.ceil(_PERIOD / self._dt - 1e-9)))
        self.period = self._period_steps * self._dt
        """Time between two decisions [s]."""
        self.kinematics, self.query = ForwardKinematics(model), DistanceQuery(scene, table)
        # a velocity may be asked for that is farther away than jerk limits allow in a period
        free = replace(settings.bounds, jerk=np.full(model.nv, np.inf))
        relaxed = replace(settings, bounds=free, dt=self.period)
        self._layout = lay_out(relaxed, (), (), self.kinematics, self.query)
        self.packed, self._views = kernels.pack(self._layout), dict[int, Near]()
        self._is_vector_space = all(joint.nv <= 1 for joint in list(model.joints)[1:])
        """Whether configurations add up: joints of one coordinate at most."""
        self.ramps = Ramps(settings.bounds, self._dt)
        """Velocity ramps within the limits."""
        self.lever_arm = max(1.0, max_lever_arm(model, table.max_extension()))
        """Bound on the distance that a point of the robot moves when a joint moves by 1 [m/rad, 1]."""
        self.sufficient_score = BackupScore(HORIZON, _DISTANCE_SCALE * settings.safety_distance)
        """Score from which on a backup trajectory need not be improved."""
        zero = np.zeros(model.nv)
        self.stop_policy = BackupPolicy(0.0, zero)
        """Braking to a standstill."""
        # every kernel once, so that no control step waits for the compiler
        near = self._evaluate(scene.robot.home, 0.0, zero, _Contacts(Start(zero, zero, zero, 0.0, self.enabled)), 0.0)
        kernels.closes_below(*near, zero, 1.0, 0.0)
        self.ramps.follow(zero, zero, self._policy_velocity(near, BackupPolicy(0.1, zero))[None])

    @property
    def enabled(self) -> Mask:
        """(m,) pairs whose distance depends on a joint, and that may not come into contact."""
        return np.asarray(self.query.table.separable & ~self.query.table.ignored)

    def advance(self, trajectory: BackupTrajectory) -> BackupTrajectory:
        """Return a trajectory without its first control step."""
        (q, v_prev, _, t, enabled), v = trajectory.start, trajectory.v[0]
        start = Start(pin.integrate(self._model, q, self._dt * v), v, v - v_prev, t + self._dt, enabled)
        return trajectory._replace(start=start, v=trajectory.v[1:])

    def is_valid_from(self, trajectory: BackupTrajectory, start: Start, max_obstacle_speed: float = 0.0) -> bool:
        """Return whether a sufficient trajectory is certainly so from a start close to its own, without a rollout.

        The same velocities lead through the same poses, up to the offset of the start and what is lost until they are
        reached. No point of the robot is off by more than the longest lever arm times the sum of that over the joints;
        and no point of an obstacle by more than the error of its prediction, plus its motion, at most at
        `max_obstacle_speed` [m/s], in the time by which the start is early or late.
        """
        if trajectory.contact_time < start.t + HORIZON - 1e-9:
            return False
        delay = abs(start.t - trajectory.start.t)
        if delay > self._dt or not np.array_equal(trajectory.start.enabled, start.enabled):
            return False
        offset = pin.difference(self._model, trajectory.start.q, start.q)
        max_offset = float(np.abs(offset).sum())
        if self.ramps.has_acceleration_limits:
            ramp = self.ramps.follow(start.v, start.dv, trajectory.v, stop_when_met=True)
            offset = offset + self._dt * np.cumsum(ramp - trajectory.v[: len(ramp)], axis=0)
            max_offset = max(max_offset, float(np.abs(offset).sum(axis=1).max(initial=0.0)))
        obstacle_offset = (delay * max_obstacle_speed if delay > _ROUND_OFF else 0.0) + prediction_error_bound(
            self._obstacles.estimates, trajectory.estimates, HORIZON + _BEYOND, self.query.obstacle_radii
        )
        clearance = trajectory.clearance - self.lever_arm * max_offset - obstacle_offset
        return bool(clearance >= self.sufficient_score.clearance)

    def rollout(
        self, start: Start, policy: BackupPolicy, prefix: Array | None, must_beat: BackupTrajectory | None
    ) -> BackupTrajectory | None:
        """Compute a backup trajectory, with a decision in every period until the horizon.

        Distances are evaluated as often, and midway where a pair may come too near and part again before that. A pair
        that has been in contact does not count any more. All trajectories decide and evaluate at the same times,
        multiples of the period, so that their scores can be compared; and at the end of the prefix.

        Args:
            start: where it begins.
            policy: how it keeps away.
            prefix: velocities (k, nv) of the first control steps, before the policy decides.
            must_beat: a trajectory; the rollout ends as soon as its score is no better.

        Returns:
            The trajectory; None if it is no better than the other one.
        """
        q, v, dv, t, _ = start
        end, velocities, contacts = t + HORIZON + _BEYOND, list[Array](), _Contacts(start)
        sufficient = self.sufficient_score.clearance
        near = self._evaluate(q, t, v, contacts, 0.0)
        remaining = np.zeros((0, len(v))) if prefix is None else prefix
        for _ in range(int((HORIZON + _BEYOND) / self._dt) + 2):
            if t >= end - 1e-9:
                break
            count = self._period_steps - round(t / self._dt) % self._period_steps
            targets, remaining = remaining[:count], remaining[count:]
            decides = not len(targets)
            if decides:
                targets = self._policy_velocity(near, policy)[None].repeat(count, axis=0)
            count = len(targets)
            ramp = self.ramps.follow(v, dv, targets, decides)
            q_next, span = self._integrate(q, ramp), count * self._dt
            if kernels.closes_below(*near, ramp[count // 2], span, sufficient):
                span *= 0.5
                t += span
                self._evaluate(pin.interpolate(self._model, q, q_next, 0.5), t, v, contacts, span)
            t += span
            near = self._evaluate(q_next, t, ramp[-1], contacts, span)
            score = BackupScore(HORIZON - contacts.lost_time, min(contacts.clearance, sufficient))
            if must_beat is not None and score <= must_beat.score:
                return None
            velocities.append(ramp)
            dv = ramp[-1] - (ramp[-2] if count > 1 else v)
            q, v = q_next, ramp[-1]
        contact_time, estimates = min(contacts.time, t), self._obstacles.estimates
        v_all = np.concatenate(velocities)
        return BackupTrajectory(start, v_all, policy, score, contact_time, contacts.clearance, estimates)

    def decision_before(self, start: Start, k: int) -> int:
        """Return the last decision, as a control step, of a trajectory from `start` before step k; 0 without any."""
        return max(k - (round(start.t / self._dt) + k) % self._period_steps, 0)

    def _integrate(self, q: Array, velocities: Array) -> Array:
        """Integrate the velocities (k, nv) of successive control steps from q (nq,)."""
        if self._is_vector_space:
            return np.asarray(pin.integrate(self._model, q, self._dt * np.add.reduce(velocities)))
        for v in velocities:
            q = pin.integrate(self._model, q, self._dt * v)
        return q

    def _evaluate(self, q: Array, t: float, v: Array, contacts: _Contacts, span: float) -> Near:
        """Evaluate the rows of near pairs, and the contacts, at q (nq,) and t [s], `span` after the pose before.

        v (nv,) is the velocity of the control step before.
        """
        query = self.query
        query.place(self._obstacles.at(t))
        self.kinematics.compute(q)
        query.compute(self.kinematics.joint_poses, _INFLUENCE_DISTANCE)
        self._layout.v_prev[:] = v
        k, touching, nearest, nearest_separable = kernels.backup_rows(
            self.packed, q, query.pairs, _INFLUENCE_DISTANCE, query.is_moving, contacts.enabled, TOUCH
        )
        contacts.add(touching, nearest, nearest_separable, t, span)
        if k not in self._views:
            x = self._layout
            self._views[k] = x.closest[:k], x.J[:k], x.feedforward[:k]
        return self._views[k]

    def _policy_velocity(self, near: Near, policy: BackupPolicy) -> Array:
        """Compute the velocity (nv,) of a policy for the next period; that of a stop where its QP fails."""
        x, (h, bias) = self._layout, policy
        v: Array | float = 0.0
        if h:
            farthest, converged = kernels.max_clearance_velocity(
                h, *near, PREFERRED_DISTANCE, _MAX_DEPTH, _EFFORT_WEIGHT, bias, x.lower, x.upper
            )
            v = farthest if converged else v
        return np.asarray(np.minimum(np.maximum(v, x.lower), x.upper))
