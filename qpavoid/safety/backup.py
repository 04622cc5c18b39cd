"""Gatekeeper: follows the tasks only while a backup trajectory from the next state stays clear of moving obstacles.

A solver that uses the distances and velocities of one control step can be trapped by obstacles that close in from
several sides: when rows first bind, it is too late. So before a velocity is commanded, backup trajectories are computed
from the state that it leads to: the robot drops its tasks and keeps away from everything, for a second or two, while
obstacles move as predicted. While one of them stays clear, the velocity may be commanded, and that trajectory is kept.
If none does, the kept trajectory is followed instead: it was verified, and stays clear as long as obstacles move as
predicted. This is the scheme of Agrawal, Chen and Panagou 2023, "gatekeeper: Online safety verification and control for
nonlinear systems in dynamic environments", with rollouts of `qpavoid.safety.rollout` as its backup.

Which policy stays clear is not known beforehand, and a rollout takes longer than a control step may. So candidates are
computed one after the other, a fixed number of poses in every control step. Each begins in the state after the present
command, with the velocities that will be commanded until it is known, and is cut by the control steps that have passed
when it is. Meanwhile the kept trajectory counts. While none is known, as in the first control steps near an obstacle,
the velocity of the solver is commanded, whose stop was looked ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil

import numpy as np
import pinocchio as pin

from qpavoid.control.assembler import RowAssembler
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.errors import NumericalError
from qpavoid.kernels.rollout import FINISHED, HORIZON, PAUSED, TOUCH
from qpavoid.problem import Array, Mask, Proximity
from qpavoid.safety.approach import ApproachCheck, SettledSteps
from qpavoid.safety.candidates import BackupPolicies, Command, least_score, not_worse
from qpavoid.safety.rollout import LEAST_SCORE, ROUND_OFF, BackupRollouts, BackupScore, BackupTrajectory, Start

_PERIOD_FRACTION = 0.128
"""Fraction of a control period in which candidates are computed [-]."""
_POSE_TIME, _SEARCH_TIME = 10.5e-6, 80e-6
"""Time that a pose of a candidate takes, and that a search takes besides [s]: of a Panda among 50 obstacles."""
_BEGIN_POSES = 8
"""Poses that take as long as it takes to begin a candidate [-]: at its first pose, all distances are new."""
_FEWEST_POSES = 10
"""Poses that are evaluated in a control step at least [-]: a candidate has about 45, and an obstacle does not wait."""
_CANDIDATES_AHEAD = 3
"""Candidates that can be computed before the kept trajectory is no longer valid [-]: as many may fail. It holds the
velocity of the solver as long, and the next one is begun so early."""
_STEPS_BETWEEN = 4
"""Control steps between two checks that the kept trajectory lasts so long [-], where all motions are known."""
_FIRST_CANDIDATES = 7
"""Candidates that are tried near an obstacle before one is followed that does not suffice [-]."""
_URGENT = 0.5
"""Time before a contact in which the best candidate is followed all the same [s]."""
_PORTION = 4
"""Poses that are evaluated, at 10 to 15 µs each, before a clock is read, where there is a budget [-]; of each control
step, these at least."""
_CLOSE = 5e-3
"""Distance by which points of the robot may be off a trajectory that is followed because others are worse [m]."""
_WITH_TASK, _ALONE = range(2)
"""Kinds of candidates: with the velocity of the solver first; with that of the kept trajectory alone."""
_CYCLE = 8, 4
"""Candidates of each kind after which those that are not sampled are tried again."""


class BackupPlanner:
    """Decides between the velocity of the solver and the first one of a backup trajectory."""

    def __init__(self, settings: ControlSettings, rows: RowAssembler, obstacles: ObstacleTracker) -> None:
        """Begin without a backup trajectory; `rows` are those of the control step."""
        self._model, self._obstacles, self._dt = settings.scene.robot.model, obstacles, settings.dt
        self._rollouts = BackupRollouts(settings, rows.query.table, obstacles)
        self._settled = SettledSteps(self._rollouts, rows)
        self.approach = ApproachCheck(settings, rows.query, self._rollouts.lever_arm, obstacles)
        self._policies = BackupPolicies(settings.scene.robot.model.nv)
        self._poses = max(_FEWEST_POSES, round((_PERIOD_FRACTION * settings.dt - _SEARCH_TIME) / _POSE_TIME))
        """Poses of candidates that are evaluated in a control step: 114 at 100 Hz, 17 at 500 Hz."""
        self._candidate_poses = self._rollouts.usual_poses + _BEGIN_POSES
        """Poses that take as long as a candidate."""
        self._steps_ahead = ceil(_CANDIDATES_AHEAD * self._candidate_poses / self._poses)
        """Control steps in which that many candidates are computed."""
        self._budget = settings.budget
        self.is_cut = False
        """Whether the search of this control step was cut by the budget while no backup trajectory is known."""
        self._last_enabled = self._rollouts.enabled
        self.reset()

    def reset(self) -> None:
        """Drop the backup trajectory, and restart the random sequence."""
        self._policies.restart()
        self.approach.reset()
        self._forget()

    def brake_with(self, acceleration: Array) -> None:
        """Take accelerations (nv,) as those on which braking counts from now on [rad/s² or m/s²]."""
        self._rollouts.brake_with(acceleration)
        self.approach.brake_with(acceleration)

    def _forget(self) -> None:
        """Drop the kept trajectory and the candidate."""
        self._backup: BackupTrajectory | None = None
        """Kept, from the present state on."""
        self._kind, self._age = -1, 0
        """Of the candidate, -1 without one; control steps since it began."""
        self._lasting_steps = self._behind = 0
        """Control steps for which the kept trajectory is known to last long enough; that were settled since it was cut
        last."""
        self._tried, self._untried = [0, 0], _FIRST_CANDIDATES
        self._policies.begin()
        self._moving = self._obstacles.moving

    @property
    def velocities(self) -> Array:
        """Return the velocities (k, nv) of the control steps of the backup trajectory; none without one."""
        self._catch_up()
        return np.zeros((0, self._model.nv)) if self._backup is None else self._backup.v

    @property
    def is_active(self) -> bool:
        """Whether there is a backup trajectory or a candidate: while nothing moves, `check` would only drop it."""
        return self._backup is not None or self._kind >= 0

    @property
    def is_idle(self) -> bool:
        """Whether nothing that moves was near in the control step before, and the same obstacles move."""
        return not self.is_active and self._moving is self._obstacles.moving

    def allows(self, v: Array, t: float) -> bool:
        """Return whether v (nv,), that of a settled step at t [s], may be commanded with nothing to search for.

        So it is where nothing that moves is near, nor was; and where the kept trajectory stays valid: that counts.
        """
        if self.is_idle:
            return not len(self._moving) or self.approach.is_far(v, t)
        backup, steps, same = self._backup, self._behind + 1, self._moving is self._obstacles.moving
        if backup is None or self._kind >= 0 or not (same and self._lasting_steps) or len(self._obstacles.external):
            return False
        if not self._settled.leaves_valid(backup, steps, t):
            return False
        self._behind, self._lasting_steps = steps, self._lasting_steps - 1
        return True

    def _catch_up(self) -> None:
        """Cut the kept trajectory by the control steps that were settled."""
        if self._backup is not None:
            self._backup = self._rollouts.advance(self._backup, self._behind)
        self._behind = 0

    def check(
        self, q: Array, v: Array, t: float, v_prev: Array, dv_prev: Array, proximity: Callable[[], Proximity]
    ) -> Array | None:
        """Return None if v may be commanded, else the velocity (nv,) to command instead.

        Args:
            q: configuration (nq,).
            v: velocity (nv,) of the solver, after the stop look-ahead.
            t: time [s].
            v_prev: velocity (nv,) commanded in the control step before.
            dv_prev: change of velocity (nv,) in that step.
            proximity: returns the distances of this control step; pairs in contact do not count.
        """
        self.is_cut = False
        self._catch_up()
        is_same_scene = self._moving is self._obstacles.moving
        lasts = self._lasting_steps > 0 and not len(self._obstacles.external)  # as `allows` takes it
        is_near = len(self._obstacles.moving) > 0 and (lasts or not self.approach.is_far(v, t))
        if not (is_near and is_same_scene):
            self._forget()
        if not is_near:
            return None
        state = Start(q, v_prev.copy(), dv_prev.copy(), t, self._enabled(proximity()))
        backup, after_task = self._backup, self._after(state, v)
        command = Command(v, after_task, after_task, True)
        if backup is not None and len(backup.v):
            self._backup = self._rollouts.advance(backup)
            if not (self._is_valid(self._backup, after_task) or self._may_wait(self._backup)):
                command = Command(backup.v[0], self._after(state, backup.v[0]), after_task, False)
        else:
            self._backup = None
        command = self._search(state, command, command.is_task or self._is_valid(backup, state))
        self.is_cut = self._backup is None and self._budget.is_spent
        return None if command.is_task else _unless_equal(command.v, v)

    def _enabled(self, proximity: Proximity) -> Mask:
        """Return the enabled pairs (m,), without those in contact."""
        enabled = self._rollouts.enabled
        enabled[proximity.pair[proximity.distance < TOUCH]] = False
        if enabled.tobytes() != self._last_enabled.tobytes():
            self._last_enabled = enabled
        return self._last_enabled  # the same array, so that it need not be compared again

    def _after(self, state: Start, v: Array) -> Start:
        """Return the state after a control step at v (nv,)."""
        q = self._moved(state.q, self._dt * v)
        return Start(q, v, v - state.v, state.t + self._dt, state.enabled)

    def _moved(self, q: Array, displacement: Array) -> Array:
        """Return the configuration (nq,) after a displacement (nv,)."""
        return q + displacement if self._rollouts.adds_up else pin.integrate(self._model, q, displacement)

    def _is_valid(self, trajectory: BackupTrajectory | None, start: Start) -> bool:
        """Return whether a trajectory is certainly sufficient from a start close to its own."""
        return trajectory is not None and self._rollouts.is_valid_from(trajectory, start, self.approach.max_speed)

    def _may_wait(self, backup: BackupTrajectory) -> bool:
        """Return whether the search has just begun, and the best trajectory so far leads to no contact soon."""
        return self._untried > 0 and backup.score.time_to_contact > _URGENT

    def _search(self, state: Start, command: Command, is_valid: bool) -> Command:
        """Evaluate the poses of this control step; return what is commanded with what they show.

        A candidate with the velocity of the solver, of some steps ago, may be better than what is kept, and yet not fit
        that velocity as it is now: then it is kept and followed instead.

        Args:
            state: present one.
            command: of this control step, with the kept trajectory.
            is_valid: whether that is certainly sufficient.
        """
        poses, rollouts, self._age = self._poses, self._rollouts, self._age + 1
        if command.is_task and self._kind == _ALONE:
            self._kind = -1
        while True:
            if self._kind < 0:
                if self._steps_needed(poses) > self._steps_needed(self._poses) or self._lasts(command):
                    break
                self._begin(command, is_valid, poses)
                poses = max(poses - _BEGIN_POSES, 1)
            portion = min(poses, _PORTION) if self._budget.is_limited else poses
            try:
                code = rollouts.resume(portion)
            except NumericalError:  # of a predicted state
                self._kind = -1
                raise
            poses -= portion - rollouts.poses_left
            if code == PAUSED:
                if poses > 0 and not self._budget.is_spent:
                    continue
                break
            kind, self._kind = self._kind, -1
            begun = rollouts.result() if code == FINISHED else None
            if begun is None or len(begun.v) <= self._age:
                continue
            candidate = rollouts.advance(begun, self._age)
            if kind == _ALONE:
                self._backup, self._lasting_steps = candidate, 0
            elif self._is_acceptable(candidate, command.after_task):
                self._backup, self._lasting_steps, command = candidate, 0, command.to_task()
                if candidate.score >= rollouts.sufficient_score:
                    self._tried, self._untried, is_valid = [0, 0], 0, True
                    self._policies.begin()
                    if self._age == 0:
                        break
            elif (
                self._age and not command.is_task and self._backup is not None and candidate.score > self._backup.score
            ):
                now = rollouts.advance(begun, self._age - 1)
                if self._begins_at(now, state):
                    self._backup, self._lasting_steps = candidate, 0
                    command = command._replace(v=now.v[0], after=self._after(state, now.v[0]))
        return command

    def _lasts(self, command: Command) -> bool:
        """Return whether the kept trajectory will be valid until others are known, if the same is commanded."""
        if self._backup is None or not command.is_task:
            return False
        if self._lasting_steps > 0:
            self._lasting_steps -= 1
            return True
        if len(self._obstacles.external) == 0 and self._is_valid_after(self._steps_ahead + _STEPS_BETWEEN - 1, command):
            self._lasting_steps = _STEPS_BETWEEN - 1
            return True
        return self._is_valid_after(self._steps_ahead, command)

    def _is_valid_after(self, steps: int, command: Command) -> bool:
        """Return whether the kept trajectory will be valid some steps later, if the same is commanded."""
        start, backup = command.after, self._backup
        if backup is None or len(backup.v) <= steps:
            return False
        q = self._moved(start.q, steps * self._dt * start.v)
        later = Start(q, start.v, np.zeros_like(start.v), start.t + steps * self._dt, start.enabled)
        return self._is_valid(self._rollouts.advance(backup, steps), later)

    def _is_acceptable(self, candidate: BackupTrajectory, after_task: Start) -> bool:
        """Return whether the velocity of the solver may be commanded with a candidate that begins with it."""
        backup, sufficient = self._backup, self._rollouts.sufficient_score
        if backup is None or self._is_valid(candidate, after_task):
            return True
        if backup.score >= sufficient:
            return False
        clearance = self._rollouts.clearance_from(candidate, after_task)  # the solver may lead elsewhere by now
        score = candidate.score._replace(clearance=min(clearance, candidate.score.clearance))
        return clearance >= TOUCH and not_worse(score, backup.score, self._rollouts.period, self._dt)

    def _begins_at(self, trajectory: BackupTrajectory, state: Start) -> bool:
        """Return whether a trajectory begins close to a state: limits and recovery may have changed commands."""
        offset = trajectory.clearance - self._rollouts.clearance_from(trajectory, state)
        return abs(state.t - trajectory.start.t) <= ROUND_OFF and offset <= _CLOSE

    def _begin(self, command: Command, is_valid: bool, poses: int) -> None:
        """Begin the next candidate, of which some poses can be evaluated in this control step."""
        self._kind = _WITH_TASK if is_valid or self._backup is None or sum(self._tried) % 2 else _ALONE
        if self._backup is None:
            self._tried[_WITH_TASK] = max(self._tried[_WITH_TASK], 2)
        number, self._age = self._tried[self._kind] % _CYCLE[self._kind], 0
        self._tried[self._kind] += 1
        self._untried -= 1
        steps = self._steps_needed(poses)
        begin = self._begin_with_task if self._kind == _WITH_TASK else self._begin_alone
        begin(command, number, steps)

    def _begin_with_task(self, command: Command, number: int, steps: int) -> None:
        """Begin a candidate that goes on with the velocity of the solver, in so many control steps."""
        backup, v = self._backup, command.after_task.v
        start, prefix = command.after_task, np.tile(v, (steps + self._steps_ahead - 1, 1))
        if backup is not None and not command.is_task and steps:
            start, prefix = command.after, np.concatenate((backup.v[: steps - 1], prefix[steps - 1 :]))
        if backup is not None and number < 2:
            policy = backup.policy
            prefix = np.concatenate((prefix, backup.v[len(prefix) :])) if number == 1 else prefix
        else:
            policy = self._rollouts.stop_policy if number == 2 else self._policies.sample()
        least = least_score(backup, self._rollouts.sufficient_score, (steps + 1) * self._dt)
        self._rollouts.begin(start, policy, prefix, least)

    def _begin_alone(self, command: Command, number: int, steps: int) -> None:
        """Begin a candidate with the beginning of the kept trajectory, or with all of it: then it replaces that."""
        backup, rollouts = self._backup, self._rollouts
        assert backup is not None
        if number == 0:
            rollouts.begin(command.after, backup.policy, backup.v, LEAST_SCORE)
            return
        k = (
            rollouts.decision_before(command.after, int(self._policies.random.integers(len(backup.v) + 1)))
            if number % 2
            else 0
        )
        time, clearance = backup.score
        least = BackupScore(time - steps * self._dt if time < HORIZON else time, clearance)
        rollouts.begin(command.after, self._policies.sample(), backup.v[: max(k, steps)], least)

    def _steps_needed(self, poses: int) -> int:
        """Return the control steps after this one that a trajectory takes with so many poses in this one."""
        return max(0, ceil((self._candidate_poses - poses) / self._poses))


def _unless_equal(v: Array, other: Array) -> Array | None:
    return None if np.array_equal(v, other) else v
