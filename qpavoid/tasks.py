"""Tracking tasks: frames of the robot that follow off-line motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from qpavoid import config, kernels
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
        self._turns = np.array([i for i, task in enumerate(tasks) if task.rows == 6], dtype=np.intp)
        frames, turning = len(tasks), [tasks[i] for i in self._turns]
        split, total = 3 * frames, 3 * (frames + len(turning))
        self._screws = np.zeros((total, 6))
        self._screws[:split, :3] = np.tile(np.eye(3), (frames, 1))
        self._screws[split:, 3:] = np.tile(np.eye(3), (len(turning), 1))
        carriers = support[np.array(joints, dtype=np.intp)]
        weights = [task.settings.weight for task in tasks] + [task.settings.orientation_weight for task in turning]
        self._scale, self._damping = np.sqrt(np.repeat(np.array(weights), 3)), damping
        moved = np.repeat(np.concatenate((carriers, carriers[self._turns])), 3, axis=0)
        self._support = moved * self._scale[:, None]
        self._gain = np.array([[task.settings.gain] for task in tasks])
        self._position, self._rotation = np.empty((frames, 3)), np.empty((frames, 3, 3))
        self._linear, self._angular = np.empty((frames, 3)), np.empty((frames, 3))
        caps = [task.settings.max_speed for task in tasks] + [task.settings.max_turn_rate for task in turning]
        self._caps = [
            (slice(3 * i, 3 * i + 3), cap * self._scale[3 * i]) for i, cap in enumerate(caps) if cap is not None
        ]

    def compute(self, kinematics: Kinematics, targets: Sequence[Sample]) -> Tracking:
        """Rows v_frame = v_ref + K (x_ref - x), in world axes, scaled with the roots of their weights.

        The orientation error is the rotation vector of R_ref Rᵀ. Linear rows of all frames come before angular ones.

        Args:
            kinematics: of this tick, its frames in the order of the tasks.
            targets: where each task's frame should be now, and how fast.
        """
        position, rotation, linear, angular = self._position, self._rotation, self._linear, self._angular
        for i, target in enumerate(targets):
            position[i], rotation[i], linear[i], angular[i] = target
        A, b = kernels.frame_rows(
            self._screws, self._turns, kinematics.poses, position, rotation, linear, angular, self._gain,
            self._scale, kinematics.J, self._support,
        )  # fmt: skip
        for rows, cap in self._caps:
            b[rows] *= min(1.0, cap / max(float(np.linalg.norm(b[rows])), 1e-12))
        return Tracking(A, b, self._damping)
