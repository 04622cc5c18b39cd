"""Forward kinematics and Jacobians of one configuration, by Pinocchio."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.memory import read_poses, view_poses
from qpavoid.problem import Array


class Kinematics(NamedTuple):
    """Where the tracked frames are, and how everything moves with v. J is valid until the next call on its data."""

    J: Array
    """(6, nv) world Jacobian: column j is the twist of joint j [linear velocity of the body point at the world
    origin; angular velocity], for every joint of the robot."""
    poses: Array
    """(f, 12) world poses of the tracked frames: rotation by columns, then position [m]."""

    @property
    def position(self) -> Array:
        """(f, 3) world positions of the tracked frames [m]."""
        return self.poses[:, 9:]

    @property
    def rotation(self) -> Array:
        """(f, 3, 3) world orientations of the tracked frames."""
        return np.swapaxes(self.poses[:, :9].reshape(-1, 3, 3), 1, 2)


class ForwardKinematics:
    """Joint placements, world Jacobian and the poses of some frames, in data that every call overwrites."""

    def __init__(self, model: Any, frame_ids: Sequence[int] = ()) -> None:
        """Lays the memory out.

        Args:
            model: pinocchio model.
            frame_ids: the f frames to report.
        """
        self.data = model.createData()
        self._model, self._ids = model, list(frame_ids)
        self._index = np.array(self._ids, dtype=np.intp)
        self._view = view_poses(self.data.oMf)
        self._J = self.data.J

    def compute(self, q: Array) -> Kinematics:
        """Kinematics at a configuration q (nq,); `data` then holds the joint placements."""
        model, data = self._model, self.data
        pin.computeJointJacobians(model, data, q)
        for frame_id in self._ids:
            pin.updateFramePlacement(model, data, frame_id)
        poses = read_poses(data.oMf) if self._view is None else self._view
        return Kinematics(self._J, poses[self._index])


def support_masks(model: Any) -> Array:
    """Which velocity coordinates move which joint: (njoints, nv) of 0 and 1, row 0 (the world) all 0."""
    mask = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        for ancestor in list(model.supports[joint])[1:]:  # without the world, which supports everything
            start, width = model.joints[ancestor].idx_v, model.joints[ancestor].nv
            mask[joint, start : start + width] = 1.0
    return mask
