"""Rollouts of backup trajectories: the robot drops its tasks and keeps away from everything.

Obstacles follow their trajectories, or are predicted at constant velocity. In every period a backup trajectory
maximises the smallest distance at a horizon h, to first order:

    max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= c,  lower <= v <= upper

with c the preferred distance. This is greedy, and runs into dead ends; which bias v̂ leads out of one is not known
beforehand (see `qpavoid.safety.backup`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.config import Avoidance, Backup, Limits
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.estimates import prediction_error_bound
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.pair_table import PairTable
from qpavoid.control.row_layout import lay_out
from qpavoid.model.kinematics import ForwardKinematics, max_lever_arm
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Mask
from qpavoid.safety.jerk import Ramps
from qpavoid.safety.policy import (
    TOUCH,
    BackupPolicy,
    BackupScore,
    BackupTrajectory,
    ContactAccumulator,
    Near,
    Start,
)

_EFFORT_WEIGHT = 1e-4
"""ε: weight of the square of a joint speed beside that of a distance [m²/(rad/s)²]; only breaks ties."""
_MAX_DEPTH = 10.0
"""Lower bound of s in the QP [m]: deeper than any penetration."""
_ROUND_OFF = 1e-6
"""Difference of two times that counts as none [s]."""
_BEYOND = 0.1
"""Time by which a rollout exceeds the horizon [s], so that it stays valid for some control steps."""


class BackupRollouts:
    """Computes backup trajectories, on kinematics and distances of its own."""

    def __init__(
        self,
        scene: Scene,
        table: PairTable,
        bounds: JointBounds,
        obstacles: ObstacleTracker,
        avoidance: Avoidance,
        limits: Limits,
        dt: float,
        settings: Backup,
    ) -> None:
        """Allocate all memory, and compile all kernels.

        Args:
            scene: robot and obstacles.
            table: its bodies and pairs, with what is attached to the robot.
            bounds: limits of the joints.
            obstacles: states of the obstacles.
            avoidance: distances and rows of the controller.
            limits: use of the joint limits.
            dt: control period [s].
            settings: horizon, period and distances.
        """
        model = scene.robot.model
        self._model, self._obstacles, self.settings, self._dt = model, obstacles, settings, dt
        self._period_steps = max(1, int(np.ceil(settings.period / dt - 1e-9)))
        self.period = self._period_steps * dt
        """Time between two decisions [s]."""
        self.kinematics, self.query = ForwardKinematics(model), DistanceQuery(scene, table)
        # a velocity may be asked for that is farther away than jerk limits allow in a period
        free = replace(bounds, jerk=np.full(model.nv, np.inf))
        self._layout = lay_out(scene, (), (), free, self.kinematics, self.query, avoidance, limits, 0.01, self.period)
        self._packed = kernels.pack(self._layout)
        self._views: dict[int, Near] = {}
        self._no_velocities = np.zeros((0, model.nv))
        self._is_vector_space = all(joint.nv <= 1 for joint in list(model.joints)[1:])
        """Whether configurations add up: joints of one coordinate at most."""
        self.separable_pairs = self._find_separable_pairs()
        """(m,) pairs whose distance depends on a joint."""
        self.ramps = Ramps(bounds, dt)
        """Velocity ramps within the limits."""
        self.lever_arm = max(1.0, max_lever_arm(model, table.max_extension()))
        """Bound on the distance that a point of the robot moves when a joint moves by 1 [m/rad, 1]."""
        self.sufficient_score = BackupScore(
            settings.horizon, settings.distance_scale * (avoidance.safety_distance - avoidance.offset)
        )
        """Score from which on a backup trajectory need not be improved."""
        self.stop_policy = BackupPolicy(0.0, np.zeros(model.nv))
        """Braking to a standstill."""
        self._compile(scene.robot.home)

    def _compile(self, q: Array) -> None:
        """Call every kernel once, so that no control step waits for the compiler."""
        zero = self.stop_policy.bias_velocity
        start = Start(q, zero, zero, 0.0, self.separable_pairs)
        near = self._evaluate(q, 0.0, zero, ContactAccumulator(start, 1.0), 0.0)
        kernels.closes_below(*near, zero, 1.0, 0.0)
        kernels.min_sphere_distance(np.zeros((1, 1, 3)), np.zeros((1, 3)), np.zeros((1, 1)))
        self.ramps.follow(zero, zero, self._policy_velocity(near, BackupPolicy(0.1, zero))[None])

    def invalidate(self) -> None:
        """Take in that attached objects, or the disabled pairs, have changed."""
        self.separable_pairs = self._find_separable_pairs()

    def _find_separable_pairs(self) -> Mask:
        return np.asarray(np.any(self._layout.support != 0.0, axis=1))

    def advance(self, trajectory: BackupTrajectory) -> BackupTrajectory:
        """Return a trajectory without its first control step."""
        (q, v_prev, _, t, enabled), v = trajectory.start, trajectory.v[0]
        start = Start(pin.integrate(self._model, q, self._dt * v), v, v - v_prev, t + self._dt, enabled)
        return trajectory._replace(start=start, v=trajectory.v[1:])

    def is_valid_from(self, trajectory: BackupTrajectory, start: Start, max_obstacle_speed: float = 0.0) -> bool:
        """Return whether a sufficient trajectory is certainly so from a start close to its own, without a rollout.

        The same velocities lead through the same poses, up to the offset of the start and what is lost until they are
        reached. No point of the robot is off by more than the longest lever arm times the sum of that over the joints;
        and no point of an obstacle by more than the error of its prediction, plus its motion in the time by which the
        start is early or late.

        Args:
            trajectory: the one in question.
            start: where it would begin.
            max_obstacle_speed: largest speed of any point of an obstacle [m/s].
        """
        if trajectory.contact_time < start.t + self.settings.horizon - 1e-9:
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
        span = self.settings.horizon + _BEYOND
        obstacle_offset = (delay * max_obstacle_speed if delay > _ROUND_OFF else 0.0) + prediction_error_bound(
            self._obstacles.estimates, trajectory.estimates, span, self.query.obstacle_radii
        )
        clearance = trajectory.clearance - self.lever_arm * max_offset - obstacle_offset
        return bool(clearance >= self.sufficient_score.clearance)

    def simulate(self, start: Start, policy: BackupPolicy, prefix: Array | None = None) -> BackupTrajectory:
        """Compute a trajectory to its end, however good; see `rollout`."""
        trajectory = self.rollout(start, policy, prefix, None)
        assert trajectory is not None
        return trajectory

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
        horizon, sufficient = self.sufficient_score
        end, velocities, contacts = t + horizon + _BEYOND, list[Array](), ContactAccumulator(start, horizon)
        near = self._evaluate(q, t, v, contacts, 0.0)
        remaining = self._no_velocities if prefix is None else prefix
        for _ in range(int((horizon + _BEYOND) / self._dt) + 2):
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
            score = BackupScore(horizon - contacts.lost_time, min(contacts.clearance, sufficient))
            if must_beat is not None and score <= must_beat.score:
                return None
            velocities.append(ramp)
            dv = ramp[-1] - (ramp[-2] if count > 1 else v)
            q, v = q_next, ramp[-1]
        return BackupTrajectory(
            start,
            np.concatenate(velocities),
            policy,
            score,
            min(contacts.contact_time, t),
            contacts.clearance,
            self._obstacles.estimates,
        )

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

    def _evaluate(self, q: Array, t: float, v: Array, contacts: ContactAccumulator, span: float) -> Near:
        """Evaluate the rows of near pairs, and the contacts.

        Args:
            q: configuration (nq,).
            t: time at which the obstacles are predicted [s].
            v: velocity (nv,) of the control step before.
            contacts: which pairs count, and where their contacts are added.
            span: time since the last evaluation [s].
        """
        query, influence_distance = self.query, self.settings.influence_distance
        query.place(self._obstacles.at(t))
        self.kinematics.compute(q)
        query.compute(self.kinematics.joint_poses, influence_distance)
        self._layout.v_prev[:] = v
        k, touching, nearest, nearest_apart = kernels.backup_rows(
            self._packed, q, query.pairs, influence_distance, query.is_moving, contacts.enabled, TOUCH
        )
        contacts.add((touching, nearest, nearest_apart), t, span)
        return self._views.get(k) or self._view(k)

    def _view(self, k: int) -> Near:
        x = self._layout
        self._views[k] = Near(x.closest[:k], x.J[:k], x.feedforward[:k])
        return self._views[k]

    def _policy_velocity(self, near: Near, policy: BackupPolicy) -> Array:
        """Compute the velocity (nv,) of a policy for the next period."""
        lower, upper, v = self._layout.lower, self._layout.upper, None
        if policy.horizon:
            v = _farthest(near, policy, self.settings.preferred_distance, lower, upper)
        return np.minimum(np.maximum(0.0 if v is None else v, lower), upper)


def _farthest(near: Near, policy: BackupPolicy, preferred_distance: float, lower: Array, upper: Array) -> Array | None:
    """Return v (nv,) with the largest s, see above, within its bounds (nv,); None if the solver fails."""
    (closest, J, feedforward), (h, bias) = near, policy
    v, converged = kernels.max_clearance_velocity(
        h, closest, J, feedforward, preferred_distance, _MAX_DEPTH, _EFFORT_WEIGHT, bias, lower, upper
    )
    return v if converged else None
