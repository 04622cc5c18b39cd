"""Rollouts of backup trajectories: the robot drops its tasks and keeps away from everything.

Obstacles follow their trajectories, or are predicted on lines and arcs. In every period a backup trajectory
maximises the smallest distance at a horizon h, to first order:

    max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= c,  lower <= v <= upper

with c the preferred distance. This is greedy, and runs into dead ends; which bias v̂ leads out of one is not known
beforehand (see `qpavoid.safety.backup`).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from math import ceil, inf
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.pair_table import PairTable
from qpavoid.control.row_layout import lay_out
from qpavoid.control.settings import ControlSettings
from qpavoid.errors import NumericalError
from qpavoid.kernels.prediction import Prediction
from qpavoid.kernels.ramps import RampLimits
from qpavoid.kernels.rollout import (
    BEYOND,
    FINISHED,
    HORIZON,
    NOT_FINITE,
    PREFERRED_DISTANCE,
    PROGRESS,
    TO_MEASURE,
    TO_MOVE,
    RolloutArrays,
)
from qpavoid.kernels.rollout_pairs import PairMemory, near_pairs_along
from qpavoid.model.kinematics import ForwardKinematics, max_lever_arm
from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array, Mask

_PERIOD = 0.04
"""Time between two decisions of a backup trajectory, about [s]: at 1 m/s, less than half of the preferred distance."""
_INFLUENCE_DISTANCE = 0.25
"""Distance below which a pair counts [m]: what closes in at 0.5 m/s within the longest policy horizon is seen before.
At 0.2, two obstacles in 236 random scenes touch the robot that are evaded at 0.25 and 0.3, which take longer."""
_DISTANCE_SCALE = 0.5
"""Fraction of the safety distance that has to be kept [-]: predictions may be wrong by the other half."""
ROUND_OFF = 1e-6
"""Difference of two times that counts as none [s]."""
_UNLIMITED = 1e9
"""Stands for no limit of a speed [rad/s, m/s]: finite, so that 0 times it is 0."""
_ALL_POSES = 10**9
"""More poses than any rollout evaluates [-]."""


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


LEAST_SCORE = BackupScore(-inf, -inf)
"""Score that every trajectory exceeds."""


class BackupTrajectory(NamedTuple):
    """Velocities of successive control steps, and what is known of where they lead."""

    start: Start
    v: Array
    """(k, nv) of each control step."""
    q: Array
    """(k, nq) where each leads."""
    policy: BackupPolicy
    score: BackupScore
    contact_time: float
    """Time of the first contact; without one, the end [s]."""
    clearance: float
    """Least distance of the pairs without contact, at most the influence distance [m]."""
    prediction: Prediction
    """Of the obstacles, that the trajectory was computed with."""


class BackupRollouts:
    """Computes backup trajectories, on kinematics and distances of its own."""

    def __init__(self, settings: ControlSettings, table: PairTable, obstacles: ObstacleTracker) -> None:
        """Allocate all memory, and compile all kernels."""
        scene, self.dt = settings.scene, settings.dt
        model = self._model = scene.robot.model
        self._obstacles, period_steps = obstacles, max(1, int(np.ceil(_PERIOD / self.dt - 1e-9)))
        self.period = period_steps * self.dt
        """Time between two decisions [s]."""
        self.kinematics, self.query = ForwardKinematics(model), DistanceQuery(scene, table)
        self.query.set_influence_distance(_INFLUENCE_DISTANCE)
        # a velocity may be asked for that is farther away than jerk limits allow in a period
        free = replace(settings.bounds, jerk=np.full(model.nv, np.inf))
        relaxed = replace(settings, bounds=free, dt=self.period)
        layout = lay_out(relaxed, (), (), self.kinematics, self.query)
        self.packed, self._v_step = kernels.pack(layout), layout.v_step
        self._ramp_limits = _ramp_limits(settings.bounds, self.dt)
        self.is_accelerated = bool(np.isfinite(settings.bounds.acceleration).any())
        self.lever_arm = max(1.0, max_lever_arm(model, table.max_extension()))
        """Bound on the distance that a point of the robot moves when a joint moves by 1 [m/rad, 1]."""
        self.sufficient_score = BackupScore(HORIZON, _DISTANCE_SCALE * settings.safety_distance)
        """Score from which on a backup trajectory need not be improved."""
        zero = np.zeros(model.nv)
        self.usual_poses = ceil((HORIZON + BEYOND) / self.period) + 3
        """Poses of a trajectory without any midway [-]: of its start, every period, and where its prefix ends."""
        self.stop_policy = BackupPolicy(0.0, zero)
        """Braking to a standstill."""
        self._memory = self._lay_out(period_steps)
        self.packed_memory, self._progress = kernels.pack(self._memory), self._memory.progress[0]
        self._poses: Array = self._memory.progress.view(np.ndarray)["poses"]
        self._has_kernels = self.kinematics.is_compiled and not self.query.has_clouds
        # every kernel once, so that no control step waits for the compiler
        self.query.place(obstacles.current)
        self.begin(Start(scene.robot.home, zero, zero, 0.0, self.enabled), BackupPolicy(0.1, zero), None, LEAST_SCORE)
        with suppress(NumericalError):  # of a trajectory that gives nonsense: the steps say so
            self.resume(2)
        self.result()
        self.adds_up = model.nq == model.nv
        """Whether configurations and displacements add up, number by number."""
        self._offset_of_start = kernels.direct(
            kernels.offset_of_start, self.packed_memory, zero, zero, zero, zero[None], self.is_accelerated
        )
        kernels.prediction_error_bound(obstacles.prediction, obstacles.prediction, 0.0, self.query.obstacle_radii)

    def _lay_out(self, period_steps: int) -> RolloutArrays:
        """Lay out the memory of one rollout."""
        model, count = self._model, int((HORIZON + BEYOND) / self.dt) + 2 + period_steps
        progress = np.zeros(1, PROGRESS).view(np.recarray)
        s = progress[0]
        s.influence_distance = _INFLUENCE_DISTANCE
        s.dt, s.period_steps, s.sufficient = self.dt, period_steps, self.sufficient_score.clearance
        s.completes_outside = not self.query.is_compiled
        s.moves_outside = model.nq != model.nv
        return RolloutArrays(
            progress=progress,
            q=np.zeros((count + 1, model.nq)),
            v=np.zeros((count + 1, model.nv)),
            dv=np.zeros(model.nv),
            prefix=np.zeros((count, model.nv)),
            bias_velocity=np.zeros(model.nv),
            targets=np.zeros((period_steps, model.nv)),
            ramp_limits=self._ramp_limits,
            q_middle=np.zeros(model.nq),
            q_pose=np.zeros(model.nq),
            v_pose=np.zeros(model.nv),
            enabled=self.enabled,
            states=self._obstacles.current.states.copy(),
            pairs=lay_out_pairs(self.query),
        )

    def brake_with(self, acceleration: Array) -> None:
        """Take accelerations (nv,) as those on which braking counts from now on [rad/s² or m/s²]."""
        self._v_step[:], self._ramp_limits.v_step[:] = acceleration * self.period, acceleration * self.dt

    @property
    def enabled(self) -> Mask:
        """(m,) pairs whose distance depends on a joint, and that may not come into contact."""
        return np.greater(self.query.table.separable, self.query.table.ignored)

    def advance(self, trajectory: BackupTrajectory, steps: int = 1) -> BackupTrajectory:
        """Return a trajectory without its first control steps, which are as many as it has at the most."""
        if steps == 0:
            return trajectory
        start, v, q, policy, score, contact_time, clearance, prediction = trajectory
        last, elapsed = steps - 1, steps * self.dt
        dv = v[last] - (start.v if last == 0 else v[last - 1])
        start = Start(q[last], v[last], dv, start.t + elapsed, start.enabled)
        if score.time_to_contact < HORIZON:
            score = score._replace(time_to_contact=score.time_to_contact - elapsed)
        return BackupTrajectory(start, v[steps:], q[steps:], policy, score, contact_time, clearance, prediction)

    def is_valid_from(self, trajectory: BackupTrajectory, start: Start, max_obstacle_speed: float = 0.0) -> bool:
        """Return whether a sufficient trajectory is certainly so from a start close to its own, without a rollout.

        The same velocities lead through the same poses, up to the offset of the start and what is lost until they are
        reached. No point of the robot is off by more than the longest lever arm times the sum of that over the joints;
        and no point of an obstacle by more than the error of its prediction, plus its motion, at most at
        `max_obstacle_speed` [m/s], in the time by which the start is early or late.
        """
        if trajectory.contact_time < start.t + HORIZON - 1e-9:
            return False
        delay, one, two = abs(start.t - trajectory.start.t), trajectory.start.enabled, start.enabled
        if delay > self.dt or not (one is two or np.array_equal(one, two)):
            return False
        obstacle_offset = delay * max_obstacle_speed if delay > ROUND_OFF else 0.0
        now, then = self._obstacles.prediction, trajectory.prediction
        if now is not then and (len(now.external) or len(then.external)):
            radii = self.query.obstacle_radii
            obstacle_offset += kernels.prediction_error_bound(now, then, HORIZON + BEYOND, radii)
        clearance = self.clearance_from(trajectory, start) - obstacle_offset
        return clearance >= self.sufficient_score.clearance

    def clearance_from(self, trajectory: BackupTrajectory, start: Start) -> float:
        """Bound the clearance of a trajectory from below that is joined from a start off its own [m]."""
        q, q_own = start.q, trajectory.start.q
        offset = q - q_own if self.adds_up else pin.difference(self._model, q_own, q)
        v, dv = np.ascontiguousarray(start.v), np.ascontiguousarray(start.dv)
        max_offset = self._offset_of_start(self.packed_memory, offset, v, dv, trajectory.v, self.is_accelerated)
        return float(trajectory.clearance - self.lever_arm * max_offset)

    def rollout(
        self, start: Start, policy: BackupPolicy, prefix: Array | None, must_beat: BackupTrajectory | None
    ) -> BackupTrajectory | None:
        """Compute a backup trajectory in one go, which has to be better than another one; see `begin`.

        Returns:
            The trajectory; None if it is no better than the other one.
        """
        least = LEAST_SCORE if must_beat is None else must_beat.score
        self.begin(start, policy, prefix, least)
        return self.result() if self.resume(_ALL_POSES) == FINISHED else None

    def begin(self, start: Start, policy: BackupPolicy, prefix: Array | None, least_score: BackupScore) -> None:
        """Begin a backup trajectory, with a decision in every period until the horizon.

        Distances are evaluated as often, and midway where a pair may come too near and part again before that. All
        trajectories decide and evaluate at the same times, multiples of the period, so that their scores can be
        compared; and at the end of the prefix.

        Args:
            start: where it begins.
            policy: how it keeps away.
            prefix: velocities (k, nv) of the first control steps, before the policy decides.
            least_score: that it has to exceed; the rollout ends as soon as it does not.
        """
        self._start, self._policy, self._prediction = start, policy, self._obstacles.prediction
        r, count = self._memory, 0 if prefix is None else min(len(prefix), len(self._memory.prefix))
        if prefix is not None:
            r.prefix[:count] = prefix[:count]
        r.q[0], r.v[0], r.dv[:], r.bias_velocity[:] = start.q, start.v, start.dv, policy.bias_velocity
        r.enabled[:] = start.enabled
        in_python = not self._has_kernels or bool(self._obstacles.custom_trajectories)
        memory = self.packed_memory, self.query.packed
        kernels.begin_rollout(*memory, start.t, policy.horizon, count, *least_score, in_python)

    def resume(self, poses: int) -> int:
        """Go on with the rollout until it is FINISHED or DROPPED, or PAUSED after evaluating some poses.

        Raises:
            NumericalError: NaN or infinity in the state of an obstacle, as predicted; names it.
        """
        self._poses[0] = poses
        while True:
            code, *_ = kernels.advance_rollout(self.packed_memory, self.packed, self._prediction)
            if code == TO_MEASURE:
                self._measure()
            elif code == TO_MOVE:
                self._move()
            elif code == NOT_FINITE:
                self.query.place(self._obstacles.at(self._progress.t_pose, self._prediction))  # raises
            else:
                return int(code)

    @property
    def poses_left(self) -> int:
        """Poses that were not evaluated of those that `resume` was to evaluate."""
        return int(self._poses[0])

    def result(self) -> BackupTrajectory:
        """Return the trajectory that is finished."""
        steps, time_to_contact, contact_time, clearance = kernels.rollout_outcome(self.packed_memory)
        score = BackupScore(time_to_contact, min(clearance, self.sufficient_score.clearance))
        v, q = self._memory.v[1 : steps + 1].copy(), self._memory.q[1 : steps + 1].copy()
        return BackupTrajectory(self._start, v, q, self._policy, score, contact_time, clearance, self._prediction)

    def decision_before(self, start: Start, k: int) -> int:
        """Return the last decision, as a control step, of a trajectory from `start` before step k; 0 without any."""
        return max(k - (round(start.t / self.dt) + k) % len(self._memory.targets), 0)

    def _measure(self) -> None:
        """Compute the distances of a pose, as far as the kernels did not."""
        if not self._progress.measures_outside:
            self.query.finish()
            return
        query, s = self.query, self._progress
        query.place(self._obstacles.at(s.t_pose, self._prediction))
        self.kinematics.compute(self._memory.q_pose)
        if self._has_kernels:  # only trajectories are of another class
            kernels.place_bodies(query.packed, self.kinematics.joint_poses)
            near_pairs_along(query.packed, self._memory.pairs, _INFLUENCE_DISTANCE, PREFERRED_DISTANCE)
            query.finish()
        else:
            query.compute(self.kinematics.joint_poses, _INFLUENCE_DISTANCE)
        s.rows, s.is_moving = len(query.pairs), query.is_moving

    def _move(self) -> None:
        """Write configurations up to the next decision."""
        r, s = self._memory, self._progress
        first, last = s.steps, s.steps + s.count
        for i in range(first, last):
            r.q[i + 1] = pin.integrate(self._model, r.q[i], self.dt * r.v[i + 1])
        r.q_middle[:] = pin.interpolate(self._model, r.q[first], r.q[last], 0.5)


def lay_out_pairs(query: DistanceQuery) -> PairMemory:
    """Lay out what a rollout knows of the pairs of a scene."""
    m = len(query.arrays.pairs)
    return PairMemory(computed=np.zeros(m), bounds=np.full(m, inf), points=np.zeros((m, 6)), due=np.zeros(m, np.intp))


def _ramp_limits(bounds: JointBounds, dt: float) -> RampLimits:
    """Return what the limits of the joints allow in control steps of dt [s]."""
    dv_step, max_speed = bounds.finite_dv_step(dt), np.minimum(bounds.velocity, _UNLIMITED)
    return RampLimits(bounds.acceleration * dt, dv_step, max_speed, bool(np.isfinite(bounds.jerk).any()))
