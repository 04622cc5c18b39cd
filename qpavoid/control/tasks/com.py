"""The centre of mass of a robot that follows a motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.tasks.base import RowTask, length
from qpavoid.control.tasks.start import Start
from qpavoid.errors import ConfigError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.problem import Array


class Com(RowTask):
    """Centre of mass of the robot, world."""

    def __init__(self, settings: config.ComTask, start: Start) -> None:
        name, self._gain = start.robot.name, settings.gain
        if not pin.computeTotalMass(start.robot.model) > 0.0:
            raise ConfigError(f"{start.where}: {name} has no mass, so no centre of mass; give its links inertias")
        here = pin.SE3(np.eye(3), start.data.com[0])
        super().__init__(settings, start.motion(settings.motion, here), len(settings.axes))

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """See `RowTask.write_rows`."""
        n = self.rows
        center, J = kinematics.center_of_mass(q)
        error = (target.position - center)[:n]
        self._scale_into(A, b, J[:n], target.linear[:n] + self._gain * error)
        return length(error)
