"""A robot at its initial configuration, from which tasks take what their blocks leave out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qpavoid import config
from qpavoid.errors import located
from qpavoid.model.robot import Robot
from qpavoid.model.trajectory import Motion, Sample, build_motion
from qpavoid.problem import Array


@dataclass(frozen=True)
class Start:
    """Where everything is when a task is made."""

    robot: Robot
    q0: Array
    """(nq,)"""
    data: Any
    """Pinocchio's, with frame placements and centre of mass at q0."""
    folder: Path
    """Of the scenario file: the start of relative paths."""
    where: str
    """Place of the task in that file, for messages."""

    def frame_id(self, name: str, field: str = "frame") -> int:
        """Index of the frame that a field names."""
        return self.robot.frame_id(name, f"{self.where}.{field}")

    def motion(self, motion: config.Motion, start: Any = None) -> Motion:
        """Make a motion; what it leaves out is taken from the placement `start`, if there is one."""
        with located(self.where):
            sample = None if start is None else Sample.at(start.translation, start.rotation)
            return build_motion(motion, sample, self.folder)
