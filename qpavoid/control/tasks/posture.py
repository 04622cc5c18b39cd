"""Coordinates that rest, or go to a configuration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.inputs import Configurations
from qpavoid.control.tasks.base import Constant, RowTask, length
from qpavoid.control.tasks.start import Start
from qpavoid.errors import ConfigError
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.problem import Array, as_vector


class Damping(RowTask):
    """Rest of some coordinates: v = 0."""

    unit = "rad"
    bends = False
    has_goal = False

    def __init__(self, settings: config.DampingTask | config.PostureTask, start: Start) -> None:
        """Choose the coordinates; a posture has those of joints with several of them only where these are named."""
        self._model, names = start.robot.model, start.robot.matching(settings.joints, f"{start.where}.joints")
        whole, index = settings.type == "damping", list[int]()
        for name in names:
            joint = self._model.joints[self._model.getJointId(name)]
            if whole or joint.nv == 1 or name in settings.joints:
                index += range(joint.idx_v, joint.idx_v + joint.nv)
        if not index:
            raise ConfigError(f"{start.where}.joints: none of them has a coordinate; name some that move")
        super().__init__(settings, Constant(), len(index))
        self._coordinates = np.sort(index)

    def write_constant_rows(self, A: Array) -> None:
        """See `RowTask.write_constant_rows`."""
        A[np.arange(self.rows), self._coordinates] = self.scale

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """Write nothing: b is zero."""
        return 0.0


class Posture(Damping):
    """Velocity of some coordinates along the shortest way to a configuration: v = K (q_ref ⊖ q)."""

    def __init__(self, settings: config.PostureTask, start: Start) -> None:
        given, q = start.robot.configuration(settings.q, f"{start.where}.q"), start.q0.copy()
        super().__init__(settings, start)
        for name in settings.q:
            joint = self._model.joints[self._model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = given[joint.idx_q : joint.idx_q + joint.nq]
        self.motion, self._rate = Constant(q), settings.gain * self.scale
        self._configurations = Configurations(self._model)

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """See `RowTask.write_rows`."""
        error = pin.difference(self._model, q, target)[self._coordinates]
        np.multiply(error, self._rate, out=b)
        return length(error)

    def as_target(self, value: Any) -> Any:
        """Check a configuration (nq,)."""
        return as_vector("q", value, (self._model.nq,))

    def fault(self, target: Any) -> str:
        """See `RowTask.fault`."""
        faults = self._configurations.read("q", target)[1]
        return str(faults[0]) if faults else ""
