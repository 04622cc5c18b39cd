"""The angular momentum of a robot about its centre of mass, that follows a reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.tasks.base import Constant, RowTask
from qpavoid.control.tasks.start import Start
from qpavoid.errors import ConfigError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.problem import Array, as_vector, is_finite_and_bounded


class Momentum(RowTask):
    """Rows A_g v = L of the centroidal matrix: angular momentum, world axes. It goes nowhere, and has no error."""

    unit = "kg m²/s"
    has_goal = False

    def __init__(self, settings: config.MomentumTask, start: Start) -> None:
        if not pin.computeTotalMass(start.robot.model) > 0.0:
            raise ConfigError(f"{start.where}: {start.robot.name} has no mass, so no momentum; give its links inertias")
        super().__init__(settings, Constant(np.array(settings.angular)), 3)

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """See `RowTask.write_rows`."""
        self._scale_into(A, b, kinematics.momentum_matrix(q)[3:], target)
        return 0.0

    def as_target(self, value: Any) -> Any:
        """Check an angular momentum (3,) [kg m²/s]."""
        return as_vector("momentum", value, (3,))

    def fault(self, target: Any) -> str:
        """See `RowTask.fault`."""
        return "" if is_finite_and_bounded(target) else "NaN, infinity, or too large"
