"""Tasks of a scenario, made ready for the tick: frames that follow motions, and all others (`row_tasks`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.poses import as_goal
from qpavoid.control.tasks.rows import Axis, Com, Constant, Damping, Manipulability, Posture, Relative, RowTask
from qpavoid.errors import ConfigError, located
from qpavoid.model.kinematics import support_masks
from qpavoid.model.robot import Robot
from qpavoid.model.trajectory import Motion, Sample, build_motion
from qpavoid.problem import Array, IntArray, require_finite


@dataclass(frozen=True)
class FrameTask:
    """One frame and the motion that it follows."""

    frame_id: int
    motion: Motion
    settings: config.Task

    @property
    def rows(self) -> int:
        """3 for a position or an orientation, 6 for a pose."""
        return 6 if self.settings.type == "pose" else 3

    @property
    def moves(self) -> bool:
        """Whether the position counts."""
        return self.settings.type != "orientation"

    @property
    def turns(self) -> bool:
        """Whether the orientation counts."""
        return self.settings.type != "position"

    def as_target(self, value: Any) -> Any:
        """A target that was given at run time, checked: a `Sample`, or a `Pose` that rests."""
        return as_goal(value)

    def fault(self, target: Any) -> str:
        """See `RowTask.fault`."""
        return ""


AnyTask = FrameTask | RowTask


def build_tasks(
    configs: Sequence[config.AnyTask], robot: Robot, q0: Array, source: Path = Path("tasks")
) -> list[AnyTask]:
    """Tasks of a scenario; what motions and postures leave out is taken from where things are at q0.

    Args:
        configs: the scenario's `tasks`.
        robot: the robot that is controlled.
        q0: initial configuration (nq,).
        source: scenario file, named in errors and the start of relative paths.

    Raises:
        ConfigError, UnknownName: unknown frame or joint, motion or axis that cannot be used.
        NumericalError: q0 of another shape, or not finite.
    """
    q0 = require_finite("q0", q0, (robot.model.nq,))
    builder = _Builder(robot, q0, source.parent)
    tasks = []
    for index, settings in enumerate(configs):
        tasks.append(builder.build(settings, f"{source}: tasks.{index}"))
    return tasks


class _Builder:
    """Makes tasks of one robot at one configuration."""

    def __init__(self, robot: Robot, q0: Array, folder: Path) -> None:
        self._robot, self._model, self._q0, self._folder = robot, robot.model, q0, folder
        self._data = robot.model.createData()
        pin.framesForwardKinematics(self._model, self._data, q0)
        pin.centerOfMass(self._model, self._data, q0)

    def build(self, settings: config.AnyTask, where: str) -> AnyTask:
        """The task that a block asks for; `where` is its place in a file, for messages."""
        model, self._where = self._model, where
        match settings:
            case config.Task():
                frame_id = self._frame(settings.frame)
                return FrameTask(frame_id, self._motion(settings.motion, self._data.oMf[frame_id]), settings)
            case config.RelativeTask():
                a, b = self._frame(settings.relative_to, "relative_to"), self._frame(settings.frame)
                start = self._data.oMf[a].actInv(self._data.oMf[b])
                return Relative(settings, model, self._motion(settings.motion, start), a, b)
            case config.ComTask():
                mass = pin.computeTotalMass(model)
                if not mass > 0.0:
                    raise ConfigError(
                        f"{where}: {self._robot.name} has no mass, so no centre of mass; give its links inertias"
                    )
                return Com(settings, model, self._motion(settings.motion, pin.SE3(np.eye(3), self._data.com[0])))
            case config.PostureTask():
                q = self._robot.configuration(settings.q, f"{where}.q")
                q_ref = self._given(q, settings.q)
                return Posture(settings, model, Constant(q_ref), self._coordinates(settings.joints, base=False))
            case config.DampingTask():
                return Damping(settings, model, Constant(), self._coordinates(settings.joints, base=True))
            case config.LookAtTask():
                with located(where):
                    motion = build_motion(settings.motion, None, self._folder)
                return Axis(settings, model, motion, self._frame(settings.frame), _unit(settings.axis, f"{where}.axis"))
            case config.AlignTask():
                towards = Constant(_unit(settings.direction, f"{where}.direction"))
                return Axis(
                    settings, model, towards, self._frame(settings.frame), _unit(settings.axis, f"{where}.axis")
                )
            case config.ManipulabilityTask():
                return Manipulability(settings, model, Constant(), self._frame(settings.frame))

    def _frame(self, name: str, field: str = "frame") -> int:
        return self._robot.frame_id(name, f"{self._where}.{field}")

    def _motion(self, motion: config.Motion, start: Any) -> Motion:
        with located(self._where):
            return build_motion(motion, Sample.at(start.translation, start.rotation), self._folder)

    def _given(self, q: Array, values: dict[str, float]) -> Array:
        """q0 with the joints that are given at their place in q (nq,)."""
        q_ref = self._q0.copy()
        for name in values:
            joint = self._model.joints[self._model.getJointId(name)]
            q_ref[joint.idx_q : joint.idx_q + joint.nq] = q[joint.idx_q : joint.idx_q + joint.nq]
        return np.asarray(q_ref)

    def _coordinates(self, patterns: Sequence[str], base: bool) -> IntArray:
        """Which of the nv coordinates belong to some joints; those of several only if named, or if `base`."""
        names = self._robot.matching(patterns, f"{self._where}.joints")
        joints = [self._model.joints[self._model.getJointId(name)] for name in names]
        chosen = [j for name, j in zip(names, joints, strict=True) if base or j.nv == 1 or name in patterns]
        index = [i for joint in chosen for i in range(joint.idx_v, joint.idx_v + joint.nv)]
        if not index:
            raise ConfigError(f"{self._where}.joints: none of them has a coordinate; name some that move")
        return np.array(sorted(index), dtype=np.intp)


def _unit(vector: tuple[float, float, float], where: str) -> Array:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ConfigError(f"{where} has no length; give a direction such as [0, 0, 1]")
    return np.array(vector) / length


def in_order(tasks: Sequence[AnyTask]) -> tuple[list[FrameTask], list[RowTask]]:
    """Frames, those with a position first, and all other tasks: the order of their rows."""
    frames = [task for task in tasks if isinstance(task, FrameTask)]
    return sorted(frames, key=lambda task: not task.moves), [task for task in tasks if isinstance(task, RowTask)]


def task_layout(tasks: Sequence[FrameTask], others: Sequence[RowTask], model: Any) -> dict[str, Any]:
    """Arrays of the rows A v = b of the tasks, as `RowLayout` has them.

    Rows of frames are v_frame = v_ref + K (x_ref - x), in world axes, scaled with the roots of their weights; the
    orientation error is the rotation vector of R_ref Rᵀ. Linear rows of all frames come before angular ones, and the
    rows of other tasks after them.

    Args:
        tasks: frames that follow motions, those with a position first.
        others: all other tasks; they get their places here.
        model: pinocchio model.
    """
    turns = np.array([i for i, task in enumerate(tasks) if task.turns], dtype=np.intp)
    moving, turning = [task for task in tasks if task.moves], [tasks[i] for i in turns]
    split, framed = 3 * len(moving), 3 * (len(moving) + len(turning))
    row_wrenches = np.zeros((framed, 6))
    row_wrenches[:split, :3] = np.tile(np.eye(3), (len(moving), 1))
    row_wrenches[split:, 3:] = np.tile(np.eye(3), (len(turning), 1))
    joints = np.array([model.frames[task.frame_id].parentJoint for task in (*moving, *turning)], dtype=np.intp)
    weights = [task.settings.weight for task in moving] + [task.settings.orientation_weight for task in turning]
    caps = [task.settings.max_speed for task in moving] + [task.settings.max_turn_rate for task in turning]
    scale = np.sqrt(np.repeat(np.array(weights), 3))
    moved = np.repeat(support_masks(model)[joints], 3, axis=0)
    ends = framed + np.cumsum([task.rows for task in others], dtype=np.intp)
    A, b = np.zeros((ends[-1] if others else framed, model.nv)), np.zeros(ends[-1] if others else framed)
    for task, end in zip(others, ends, strict=True):
        task.lay_out(A[end - task.rows : end], b[end - task.rows : end])
    return {
        "frame_ids": np.array([task.frame_id for task in tasks], dtype=np.intp),
        "targets": np.zeros((len(tasks), 18)),
        "oriented": turns,
        "gain": np.array([task.settings.gain for task in tasks]),
        "cap": np.array([np.inf if cap is None else cap for cap in caps]),
        "scale": scale,
        "task_support": moved * scale[:, None],
        "row_wrenches": row_wrenches,
        "poses": np.zeros((len(tasks), 12)),
        "A": A,
        "b": b,
    }


def task_levels(tasks: Sequence[FrameTask], others: Sequence[RowTask]) -> tuple[IntArray, ...]:
    """Which rows belong to each priority, the first one first."""
    moving, turning = [task for task in tasks if task.moves], [task for task in tasks if task.turns]
    owners = [task.settings.priority for task in (*moving, *turning) for _ in range(3)]
    owners += [task.settings.priority for task in others for _ in range(task.rows)]
    priorities = np.array(owners, dtype=np.intp)
    return tuple(np.flatnonzero(priorities == level) for level in np.unique(priorities))
