"""Where the rows of tasks stand in A v = b, and who writes them there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from qpavoid.control.tasks.base import RowTask
from qpavoid.control.tasks.frame import FrameTask
from qpavoid.model.kinematics import ForwardKinematics, support_masks
from qpavoid.problem import Array, IntArray


def in_order(tasks: Sequence[RowTask]) -> tuple[list[FrameTask], list[RowTask]]:
    """Frames, those with a position first, and all other tasks: the order of their rows."""
    frames = [task for task in tasks if isinstance(task, FrameTask)]
    row_tasks = [task for task in tasks if not isinstance(task, FrameTask)]
    return sorted(frames, key=lambda task: not task.moves), row_tasks


_DEAD_BEAT = 0.2
"""Share of 1/dt from which on a gain counts as one that removes the error in a step [-]."""


def task_layout(frames: Sequence[FrameTask], row_tasks: Sequence[RowTask], model: Any, dt: float) -> dict[str, Any]:
    """Arrays of the rows A v = b of the tasks, as `RowLayout` has them.

    Rows are in world axes, scaled with the roots of their weights; the orientation error is the rotation vector of
    R_ref Rᵀ. Linear rows of all frames come before angular ones, and the rows of other tasks after them.

    Args:
        frames: frames that follow motions, those with a position first.
        row_tasks: all other tasks.
        model: pinocchio model.
        dt: control period [s].
    """
    turns = np.array([i for i, task in enumerate(frames) if task.turns], dtype=np.intp)
    moving, turning = [task for task in frames if task.moves], [frames[i] for i in turns]
    linear_or_angular = np.eye(2)[[0] * len(moving) + [1] * len(turning)]
    joints = np.array([model.frames[task.frame_id].parentJoint for task in (*moving, *turning)], dtype=np.intp)
    tasks = *moving, *turning, *row_tasks
    numbers = {id(task): i for i, task in enumerate((*frames, *row_tasks))}
    sizes = np.array([task.rows if task in row_tasks else 3 for task in tasks], dtype=np.intp)
    bends = np.repeat(np.array([task.bends for task in tasks], dtype=bool), sizes)
    weights = [task.settings.weight for task in moving] + [task.settings.orientation_weight for task in turning]
    caps = [task.settings.max_speed for task in moving] + [task.settings.max_turn_rate for task in turning]
    scale = np.sqrt(np.repeat(np.array(weights), 3))
    gains = np.array([getattr(task.settings, "gain", np.inf) for task in tasks])  # a user's task may have none
    rows = int(sizes.sum())
    return {
        "frame_ids": np.array([task.frame_id for task in frames], dtype=np.intp),
        "targets": np.zeros((len(frames), 18)),
        "oriented": turns,
        "gain": np.array([task.settings.gain for task in frames]),
        "cap": np.array([np.inf if cap is None else cap for cap in caps]),
        "scale": np.concatenate((scale, *(task.scale for task in row_tasks))),
        "dead_beat": np.repeat(dead_beat(gains, dt), sizes),
        "row_tasks": np.repeat(np.array([numbers[id(task)] for task in tasks], dtype=np.intp), sizes),
        "bending_rows": np.flatnonzero(bends),
        "straight_rows": np.flatnonzero(~bends),
        "task_support": np.repeat(support_masks(model)[joints], 3, axis=0) * scale[:, None],
        "row_wrenches": np.kron(linear_or_angular, np.eye(3)),
        "poses": np.zeros((len(frames), 12)),
        "errors": np.zeros(len(scale)),
        "feedback": np.zeros(len(scale)),
        "A": np.zeros((rows, model.nv)),
        "b": np.zeros(rows),
        "b_feasible": np.zeros(rows),
    }


def dead_beat(gains: Array, dt: float) -> Array:
    """Return how near each gain [1/s] is to one that removes the error in a step, at most 1 [-]."""
    return np.minimum(gains * dt / _DEAD_BEAT, 1.0)


def task_levels(frames: Sequence[FrameTask], row_tasks: Sequence[RowTask]) -> tuple[IntArray, ...]:
    """Which rows belong to each priority, the first one first."""
    ordered = *(task for task in frames if task.moves), *(task for task in frames if task.turns), *row_tasks
    owners = [task.settings.priority for task in ordered for _ in range(task.rows if task in row_tasks else 3)]
    priorities = np.array(owners, dtype=np.intp)
    return tuple(np.flatnonzero(priorities == level) for level in np.unique(priorities))


class TaskRows:
    """Rows of the tasks that write their own, in the memory of one controller."""

    def __init__(self, tasks: Sequence[RowTask], A: Array, b: Array) -> None:
        """Give each its rows: the last ones of A (r, nv) and b (r,), which are zero."""
        self.errors = np.zeros(len(tasks))
        """How far each of the tasks was from its target in the last step, in its unit."""
        self._parts, begin = list[Any](), len(b) - sum(task.rows for task in tasks)
        for task in tasks:
            rows = slice(begin, begin := begin + task.rows)
            self._parts.append((task, A[rows], b[rows]))
            task.write_constant_rows(A[rows])

    def write(self, q: Array, kinematics: ForwardKinematics, targets: Sequence[Any]) -> None:
        """Write all rows at q (nq,), for which the kinematics are up to date."""
        for i, ((task, A, b), target) in enumerate(zip(self._parts, targets, strict=True)):
            self.errors[i] = task.write_rows(q, kinematics, target, A, b)
