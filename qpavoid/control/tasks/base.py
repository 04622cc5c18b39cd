"""What all tasks share: a target, and rows A v = b."""

from __future__ import annotations

from math import hypot
from typing import Any, Protocol

import numpy as np

from qpavoid import config
from qpavoid.errors import NumericalError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import as_goal
from qpavoid.problem import Array

PARTS = {"position": slice(0, 3), "orientation": slice(3, 6), "pose": slice(0, 6)}
"""Rows of a frame's Jacobian, [linear, angular]."""


class Target(Protocol):
    """What a task is to reach, as a function of time."""

    def sample(self, t: float) -> Any:
        """Target at t [s]: a `Sample`, or what else the task's `as_target` gives."""


class Constant:
    """A target that is the same at all times."""

    def __init__(self, value: Any = None) -> None:
        self.value = value

    def sample(self, t: float) -> Any:
        """See `Target.sample`."""
        return self.value


class RowTask:
    """A target, and rows; nothing of it changes once it is made, so that controllers may share it."""

    unit = "m"
    """Of its error; `m` counts for the goal of a scenario."""
    bends = True
    """Whether its rows A turn as the robot moves."""
    has_goal = True
    """Whether it has somewhere to go, so that a lack of progress is reported."""
    moves = True
    """Whether a position counts, of a task whose target is somewhere."""

    def __init__(self, settings: config.TaskBlock, motion: Target, rows: int, frame_ids: tuple[int, ...] = ()) -> None:
        """Take over what is known beforehand.

        Args:
            settings: its block of a scenario.
            motion: its target.
            rows: how many it has.
            frame_ids: frames that have to be up to date when its rows are written.
        """
        self.settings, self.motion, self.rows, self.frame_ids = settings, motion, rows, frame_ids
        self.scale = np.full(rows, np.sqrt(settings.weight))
        """(rows,) roots of the weights, by which its rows are multiplied."""

    def write_constant_rows(self, A: Array) -> None:
        """Write what never changes of A (rows, nv), which is zero: once, when a controller is made."""

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """Write the rows A v = b, and return how far the task is from its target, in its unit.

        Args:
            q: configuration (nq,).
            kinematics: those at q.
            target: what to reach now.
            A: (rows, nv), as the step before has left them.
            b: (rows,), as well.
        """
        raise NotImplementedError

    def _scale_into(self, A: Array, b: Array, J: Array, desired: Array) -> None:
        np.multiply(J, self.scale[:, None], out=A)
        np.multiply(desired, self.scale, out=b)

    def as_target(self, value: Any) -> Any:
        """Check a target that was given at run time: here, a `Sample` or a `Pose` that rests.

        Raises:
            NumericalError: of the wrong kind or shape, or the task has no target.
        """
        if isinstance(self.motion, Constant) and self.motion.value is None:
            raise NumericalError(f"a task of type {getattr(self.settings, 'type', '?')} takes none; leave it out")
        return as_goal(value)

    def fault(self, target: Any) -> str:
        """Say why a target that is no `Sample` cannot be true; nothing if it can."""
        return ""


def frame_pose(kinematics: ForwardKinematics, frame_id: int) -> tuple[Array, Array]:
    """World position (3,) [m] and orientation (3, 3) of a frame that is kept up to date."""
    placement = kinematics.frame_poses[frame_id]
    return placement[9:], placement[:9].reshape(3, 3).T


def length(vector: Array) -> float:
    """Euclidean norm of a short vector."""
    return hypot(*vector.tolist())
