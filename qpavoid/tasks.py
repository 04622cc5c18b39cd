"""Tracking tasks: frames of the robot that follow off-line motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.errors import located
from qpavoid.kinematics import Kinematics
from qpavoid.motion import Motion, Sample, build_motion
from qpavoid.problem import Array, Tracking
from qpavoid.robot import Robot


@dataclass(frozen=True)
class FrameTask:
    """One frame and the motion that it follows."""

    frame_id: int
    motion: Motion
    settings: config.Task

    @property
    def rows(self) -> int:
        """3 for a position, 6 for a pose."""
        return 3 if self.settings.type == "position" else 6


def build_tasks(
    configs: Sequence[config.Task], robot: Robot, q0: Array, source: Path = Path("tasks")
) -> list[FrameTask]:
    """Tasks of a scenario; motions that leave their start out begin where the frame is at q0.

    Args:
        configs: the scenario's `tasks`.
        robot: the robot that is controlled.
        q0: initial configuration (nq,).
        source: scenario file, named in errors and the start of relative paths.

    Raises:
        ConfigError, UnknownName: unknown frame, motion that cannot be built.
    """
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q0)
    tasks = []
    for index, settings in enumerate(configs):
        where = f"{source}: tasks.{index}"
        frame_id = robot.frame_id(settings.frame, f"{where}.frame")
        start = Sample.at(data.oMf[frame_id].translation, data.oMf[frame_id].rotation)
        with located(where):
            motion = build_motion(settings.motion, start, source.parent)
        tasks.append(FrameTask(frame_id, motion, settings))
    return tasks


class TaskRows:
    """Turns tasks into the rows A v = b of a tick; the layout is made once."""

    def __init__(self, tasks: Sequence[FrameTask], support: Array, joints: Sequence[int], damping: float) -> None:
        """Lays the rows out.

        Args:
            tasks: the tasks, in the order of the rows.
            support: (njoints, nv) masks of `kinematics.support_masks`.
            joints: joint that carries each task's frame.
            damping: λ of the damped J⁺ [-].
        """
        self._tasks = tuple(tasks)
        sizes = [task.rows for task in tasks]
        starts = np.cumsum([0, *sizes[:-1]])
        self._slices = [slice(start, start + size) for start, size in zip(starts, sizes, strict=True)]
        self._mask = np.repeat(support[np.array(joints, dtype=np.intp)], sizes, axis=0)
        self._screws = np.zeros((sum(sizes), 6))
        weights = []
        for task, rows in zip(tasks, self._slices, strict=True):
            self._screws[rows.start : rows.start + 3, :3] = np.eye(3)
            self._screws[rows.start + 3 : rows.stop, 3:] = np.eye(3)[: task.rows - 3]
            orientation = [task.settings.orientation_weight] * (task.rows - 3)
            weights += [task.settings.weight] * 3 + orientation
        self._weight = np.array(weights)
        self._damping = damping

    def compute(self, kinematics: Kinematics, targets: Sequence[Sample]) -> Tracking:
        """Rows v_frame = v_ref + K (x_ref - x), in world axes; the orientation error is the rotation vector of
        R_ref Rᵀ.

        Args:
            kinematics: of this tick, its frames in the order of the tasks.
            targets: where each task's frame should be now, and how fast.
        """
        b = np.empty(len(self._weight))
        for i, (task, rows, target) in enumerate(zip(self._tasks, self._slices, targets, strict=True)):
            settings, x = task.settings, kinematics.position[i]
            velocity = target.linear + settings.gain * (target.position - x)
            b[rows.start : rows.start + 3] = _capped(velocity, settings.max_speed)
            # p × e for the three axes e
            self._screws[rows.start, 4:] = x[2], -x[1]
            self._screws[rows.start + 1, 3::2] = -x[2], x[0]
            self._screws[rows.start + 2, 3:5] = x[1], -x[0]
            if task.rows == 6:
                error = pin.log3(target.rotation @ kinematics.rotation[i].T)
                turn = target.angular + settings.gain * error
                b[rows.start + 3 : rows.stop] = _capped(turn, settings.max_turn_rate)
        A = (self._screws @ kinematics.J) * self._mask
        return Tracking(A=A, b=b, weight=self._weight, damping=self._damping)


def _capped(vector: Array, cap: float | None) -> Array:
    if cap is None:
        return vector
    return vector * min(1.0, cap / max(float(np.linalg.norm(vector)), 1e-12))
