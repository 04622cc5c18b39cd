"""A frame that keeps away from singularities."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.tasks.base import PARTS, Constant, RowTask, frame_pose
from qpavoid.control.tasks.start import Start
from qpavoid.model.kinematics import ForwardKinematics, column_joints, columns, support_masks
from qpavoid.problem import Array


class Manipulability(RowTask):
    """One row ∇w·v = K ‖∇w‖²: ascent of w = √det(J Jᵀ) (Yoshikawa 1985), along its gradient and free across it.

    ∂w/∂q_i = w tr(∂J/∂q_i J⁺). In the frame's own axes, on which w does not depend, ∂J_j/∂q_i = J_j × J_i (of motion
    vectors) where joint i lies beyond joint j, and 0 elsewhere. Its error is w.
    """

    unit = "w"
    has_goal = False

    def __init__(self, settings: config.ManipulabilityTask, start: Start) -> None:
        model, frame_id = start.robot.model, start.frame_id(settings.frame)
        super().__init__(settings, Constant(), 1, (frame_id,))
        self._part, self._gain = PARTS[settings.rows], settings.gain
        masks, joints = support_masks(model), column_joints(model)
        self._support = masks[model.frames[frame_id].parentJoint]
        self._beyond = masks[joints] * (joints[:, None] != joints)
        self._fold = np.eye(model.nv)[columns(model)]

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """See `RowTask.write_rows`."""
        x, R = frame_pose(kinematics, self.frame_ids[0])
        linear, angular = kinematics.J[:3] * self._support, kinematics.J[3:] * self._support
        V, W = R.T @ (linear - pin.skew(x) @ angular), R.T @ angular  # (3, e), in the frame's axes
        J = (np.concatenate((V, W)) @ self._fold)[self._part]
        gram = J @ J.T
        w = float(np.sqrt(max(np.linalg.det(gram), 0.0)))
        Y = np.zeros((6, len(self._fold)))
        Y[self._part] = (w * np.linalg.pinv(gram, rcond=1e-12) @ J) @ self._fold.T
        # Σ_j Y_j·(J_j × J_i), with [v1; w1] × [v2; w2] = [w1 × v2 + v1 × w2; w1 × w2]
        along = np.cross(Y[:3], W, axis=0)
        about = np.cross(Y[:3], V, axis=0) + np.cross(Y[3:], W, axis=0)
        gradient = (V * (along @ self._beyond.T)).sum(axis=0) + (W * (about @ self._beyond.T)).sum(axis=0)
        gradient = gradient @ self._fold
        self._scale_into(A, b, gradient, self._gain * np.dot(gradient, gradient))
        return w
