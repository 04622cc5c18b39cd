"""Forward kinematics and Jacobians of one configuration, by Pinocchio."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.problem import Array


class Kinematics(NamedTuple):
    """Where the tracked frames are, and how everything moves with v. Valid until the next call on the same data."""

    J: Array
    """(6, nv) world Jacobian: column j is the twist of joint j [linear velocity of the body point at the world
    origin; angular velocity], for every joint of the robot."""
    position: Array
    """(f, 3) world positions of the tracked frames [m]."""
    rotation: Array
    """(f, 3, 3) world orientations of the tracked frames."""


def compute_kinematics(model: Any, data: Any, frame_ids: Sequence[int], q: Array) -> Kinematics:
    """Joint placements, world Jacobian and the placements of some frames.

    Args:
        model: pinocchio model.
        data: its pinocchio data, overwritten.
        frame_ids: the f frames to report.
        q: configuration (nq,).
    """
    pin.computeJointJacobians(model, data, q)
    position = np.empty((len(frame_ids), 3))
    rotation = np.empty((len(frame_ids), 3, 3))
    for i, frame_id in enumerate(frame_ids):
        placement = pin.updateFramePlacement(model, data, frame_id)
        position[i] = placement.translation
        rotation[i] = placement.rotation
    return Kinematics(data.J, position, rotation)


def support_masks(model: Any) -> Array:
    """Which velocity coordinates move which joint: (njoints, nv) of 0 and 1, row 0 (the world) all 0."""
    mask = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        for ancestor in list(model.supports[joint])[1:]:  # without the world, which supports everything
            start, width = model.joints[ancestor].idx_v, model.joints[ancestor].nv
            mask[joint, start : start + width] = 1.0
    return mask
