"""Tracking tasks: frames of the robot that follow off-line motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.errors import located
from qpavoid.kinematics import support_masks
from qpavoid.motion import Motion, Sample, build_motion
from qpavoid.problem import Array
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


def task_layout(tasks: Sequence[FrameTask], model: Any) -> dict[str, Any]:
    """Arrays of the rows A v = b of the tasks, as `RowLayout` has them.

    Rows are v_frame = v_ref + K (x_ref - x), in world axes, scaled with the roots of their weights; the orientation
    error is the rotation vector of R_ref Rᵀ. Linear rows of all frames come before angular ones.

    Args:
        tasks: the tasks, in the order of the rows.
        model: pinocchio model.
    """
    turns = np.array([i for i, task in enumerate(tasks) if task.rows == 6], dtype=np.intp)
    frames, turning = len(tasks), [tasks[i] for i in turns]
    split, total = 3 * frames, 3 * (frames + len(turning))
    screws = np.zeros((total, 6))
    screws[:split, :3] = np.tile(np.eye(3), (frames, 1))
    screws[split:, 3:] = np.tile(np.eye(3), (len(turning), 1))
    joints = np.array([model.frames[task.frame_id].parentJoint for task in tasks], dtype=np.intp)
    carriers = support_masks(model)[joints]
    weights = [task.settings.weight for task in tasks] + [task.settings.orientation_weight for task in turning]
    caps = [task.settings.max_speed for task in tasks] + [task.settings.max_turn_rate for task in turning]
    scale = np.sqrt(np.repeat(np.array(weights), 3))
    moved = np.repeat(np.concatenate((carriers, carriers[turns])), 3, axis=0)
    return {
        "frame_ids": np.array([task.frame_id for task in tasks], dtype=np.intp),
        "targets": np.zeros((frames, 18)),
        "turns": turns,
        "gain": np.array([task.settings.gain for task in tasks]),
        "cap": np.array([np.inf if cap is None else cap for cap in caps]),
        "scale": scale,
        "task_support": moved * scale[:, None],
        "screws": screws,
        "poses": np.zeros((frames, 12)),
        "A": np.zeros((total, model.nv)),
        "b": np.zeros(total),
    }
