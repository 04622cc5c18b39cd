"""A frame that follows a motion as another frame sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.tasks.base import PARTS, RowTask, frame_pose, length
from qpavoid.control.tasks.start import Start
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.problem import Array


class Relative(RowTask):
    """Pose of one frame in the axes of another one, X = M_a⁻¹ M_b.

    d/dt of its position is Rₐᵀ (ẋ_b - ẋ_a - ω_a × (x_b - x_a)), its angular velocity Rₐᵀ (ω_b - ω_a).
    """

    def __init__(self, settings: config.RelativeTask, start: Start) -> None:
        a, b = start.frame_id(settings.relative_to, "relative_to"), start.frame_id(settings.frame)
        motion = start.motion(settings.motion, start.data.oMf[a].actInv(start.data.oMf[b]))
        scale = np.sqrt(np.repeat([settings.weight, settings.orientation_weight], 3))[PARTS[settings.rows]]
        super().__init__(settings, motion, len(scale), (a, b))
        self.moves = settings.rows != "orientation"
        self.scale, self.unit = scale, "m" if self.moves else "rad"
        self._part, self._gain = PARTS[settings.rows], settings.gain

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """See `RowTask.write_rows`."""
        (x_a, R_a), (x_b, R_b) = (frame_pose(kinematics, i) for i in self.frame_ids)
        J_a, J = (kinematics.frame_jacobian(i) for i in self.frame_ids)
        J -= J_a
        J[:3] += pin.skew(x_b - x_a) @ J_a[3:]  # -ω × r = r × ω
        missing = target.rotation @ (R_a.T @ R_b).T
        error = np.concatenate((target.position - R_a.T @ (x_b - x_a), rotation_vector(missing.tolist())))
        desired = np.concatenate((target.linear, target.angular)) + self._gain * error
        self._scale_into(A, b, (R_a.T @ J.reshape(2, 3, -1)).reshape(6, -1)[self._part], desired[self._part])
        return length(error[:3] if self.unit == "m" else error[3:])
