"""Control periods of a robot that follows its commands exactly, in compiled code as far as they are plain.

A step is plain where nothing but its kernels decides: its velocity is settled, and no obstacle comes near for which a
backup trajectory would be needed. All others are left to `Controller.tick`, which takes them as always.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.control.builder import ProblemBuilder
from qpavoid.control.inputs import LARGEST_VELOCITY
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import RowTask
from qpavoid.control.trajectories import TrajectoryBatch
from qpavoid.kernels.closed_loop import LoopCalls, LoopSetting, Periods, run_periods
from qpavoid.kernels.structures import address
from qpavoid.model.sample import POSE, STATE
from qpavoid.model.trajectory import Trajectory
from qpavoid.problem import Array, Solution
from qpavoid.safety.approach import ApproachCheck
from qpavoid.safety.arbiter import Arbiter

_CAPACITY = 256
"""Control periods in one call at most [-]."""
_NONE = np.zeros(0, dtype=np.intp)


class ClosedLoops:
    """Part of a `Controller` that lets a loop take control steps in compiled code."""

    tasks: tuple[RowTask, ...]
    _builder: ProblemBuilder
    _arbiter: Arbiter
    _planning: Any

    def closed_loop(self) -> ClosedLoop | None:
        """Return what takes plain control steps of this controller; None where it has none."""
        settings = self._arbiter.settings
        if self._planning is not None or not ClosedLoop.suits(settings, self._builder, self.tasks):
            return None
        return ClosedLoop(settings, self._builder, self._arbiter, self.tasks)


class ClosedLoop:
    """Takes plain control steps of one controller, one after the other."""

    def __init__(self, settings: ControlSettings, builder: ProblemBuilder, arbiter: Arbiter, tasks: Any) -> None:
        """Load the kernels, and lay the record out; `tasks` are those of the controller, frames with their motions."""
        self._builder, self._arbiter, self._dt = builder, arbiter, settings.dt
        rows, tracker, model = builder.rows, builder.tracker, settings.scene.robot.model
        self._targets = TrajectoryBatch({i: task.motion for i, task in enumerate(tasks)})
        watch = arbiter.backup.approach if arbiter.backup else ApproachCheck(settings, rows.query, 1.0, tracker)
        frames, obstacles = len(tasks), len(tracker.current.states)
        self.periods = Periods(
            t=np.zeros(_CAPACITY),
            q=np.zeros((_CAPACITY + 1, model.nq)),
            v=np.zeros((_CAPACITY, model.nv)),
            targets=np.zeros((_CAPACITY, frames, STATE)),
            poses=np.zeros((_CAPACITY, frames, POSE)),
            obstacles=np.zeros((_CAPACITY, obstacles, POSE)),
            alpha=np.zeros(_CAPACITY),
            beta=np.zeros(_CAPACITY),
        )
        """Record of the last `run`."""
        self.last: Solution | None = None
        """Solution of its last step, where there is more to say of it than its velocity."""
        self._watch, self._look = watch.packed, arbiter.braking.look_arguments
        look_calls, look, kinematics, later = self._look
        setting = self._setting()
        self._calls = LoopCalls(
            sample_pieces=address(kernels.sample_pieces, setting.targets, 0.0, rows.targets),
            follow_trajectories=address(kernels.follow_trajectories, tracker.packed, rows.query.packed, 0.0, _NONE),
            control_step=address(
                kernels.control_step, rows.packed, rows.q, setting.influence_distance, False, True, False
            ),
            extend_paths=address(kernels.extend_paths, self._watch, tracker.prediction.pieces, _NONE, 0),
            comes_near=address(kernels.comes_near, self._watch, rows.query.packed, rows.v, _NONE, _NONE),
            extrapolate_states=address(kernels.extrapolate_states, look.states, look.durations),
            place_obstacles=address(
                kernels.place_obstacles, later, setting.placed, look.states, tracker.current.margin
            ),
            look_along=address(
                kernels.look_along, look_calls, look, rows.query.packed, kinematics, later, rows.q, look.times,
                look.travel,
            ),
        )  # fmt: skip

    @staticmethod
    def suits(settings: ControlSettings, builder: ProblemBuilder, tasks: tuple[RowTask, ...]) -> bool:
        """Return whether a controller has plain steps: configurations that add up, motions that kernels sample.

        Args:
            settings: of the controller.
            builder: of its problems.
            tasks: of it.
        """
        model, known = settings.scene.robot.model, all(type(task.motion) is Trajectory for task in tasks)
        return builder.has_plain_steps and known and model.nq == model.nv and not settings.budget.is_limited

    def run(self, q: Array, step: int, most: int) -> int:
        """Take plain control steps, and return how many there are; `periods` records them.

        Args:
            q: configuration (nq,) in which the first one begins.
            step: its number; it begins at `step` control periods [s].
            most: number of steps to take, if all are plain.
        """
        builder, arbiter, log, done = self._builder, self._arbiter, self.periods, 0
        log.q[0], self.last = q, None
        if not (builder.is_plain_ahead(step * self._dt) and arbiter.is_plain_ahead):
            return 0
        most, setting = min(most, _CAPACITY), self._setting()
        log.t[:most] = self._dt * np.arange(step, step + most)
        builder.rows.follows_tasks = True
        calls, rows, tracker = self._calls, builder.rows, builder.tracker
        while done < most and self.last is None:
            begin, check = done, done + arbiter.progress.steps_to_check
            end = min(most, check)
            done = run_periods(
                calls, rows.packed, tracker.packed, self._watch, *self._look, rows.q, setting, log, begin, end
            )  # fmt: skip
            if done == begin:
                break
            builder.go_on(float(log.t[done - 1]))
            arbiter.progress.count(done - begin - (done == check))
            if done == check:
                solution = arbiter.monitor(None, Solution.solved(rows.v.copy()))
                self.last = solution if solution.stalled else None
            if done < end:
                break
        return done

    def _setting(self) -> LoopSetting:
        """Return what stays as it is until another step than a plain one."""
        builder = self._builder
        tracker, query = builder.tracker, builder.rows.query
        limits, squares = builder.usual_limits
        return LoopSetting(
            targets=self._targets.pieces,
            limits=limits,
            squares=squares,
            none=_NONE,
            placed=tracker.current.which,
            on_paths=tracker.on_trajectories,
            influence_distance=builder.rows.influence_distance,
            dt=self._dt,
            observes=len(tracker.moving) > 0,
            is_moving=query.is_moving,
            looks=self._arbiter.braking.is_compiled,
            watches=self._arbiter.backup is not None and len(tracker.moving) > 0,
            largest_velocity=LARGEST_VELOCITY,
        )
