"""Joints that turn a mobile base's wheels: the base's own coordinates stand for them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.geometry.bodies import bounding_box
from qpavoid.setup.shapes import Piece

_NAMES = re.compile(r"wheel|caster|castor", re.IGNORECASE)
_GROUND = 0.02
"""Height above the robot's lowest point, as a share of its own, up to which a shape stands on the ground [-]."""

_ENDLESS = 1e9
"""Position from which a limit means that there is none, as files write it [rad]."""


def wheel_joints(model: Any, pieces: Sequence[Piece]) -> list[str]:
    """Find the joints of wheels and casters of a mobile base.

    Those that are continuous and bear such a name, they or their link; and those with a horizontal axis whose
    link is a cylinder or ball that stands on the ground.

    Args:
        model: pinocchio model, its root joint planar or floating.
        pieces: geometry of its links.
    """
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    lowest, highest, round_ones = np.inf, -np.inf, dict[int, float]()
    for piece in pieces:
        frame = model.frames[model.getFrameId(piece.link, pin.BODY)]
        low, high = _heights(piece, data.oMi[frame.parentJoint] * frame.placement)
        lowest, highest = min(lowest, low), max(highest, high)
        if isinstance(piece.geometry, coal.Cylinder | coal.Sphere):
            round_ones[frame.parentJoint] = min(low, round_ones.get(frame.parentJoint, np.inf))
    wheel_names = []
    for joint in list(model.joints)[1:]:
        if not _is_continuous(model, joint):
            continue
        links = [frame.name for frame in model.frames if frame.parentJoint == joint.id and frame.type == pin.BODY]
        has_name = any(_NAMES.search(name) for name in (model.names[joint.id], *links))
        axis = _axis(model, data, joint)
        is_on_ground = round_ones.get(joint.id, np.inf) <= lowest + _GROUND * (highest - lowest)
        if has_name or (is_on_ground and abs(axis[2]) < 0.1 and not model.children[joint.id]):
            wheel_names.append(str(model.names[joint.id]))
    return wheel_names


def _heights(piece: Piece, link: Any) -> tuple[float, float]:
    """Return the lowest and highest point of a box around a piece in the world [m]."""
    center, half = bounding_box(piece.geometry)
    pose = link * piece.placement
    middle = float(pose.act(center)[2])
    half_height = float(np.abs(pose.rotation[2]) @ half)
    return middle - half_height, middle + half_height


def _is_continuous(model: Any, joint: Any) -> bool:
    """Return True if a joint is continuous: it has an angle, and no limits."""
    name = joint.shortname()
    if name.startswith("JointModelRUB") or name == "JointModelRevoluteUnboundedUnaligned":
        return True
    if not name.startswith("JointModelR"):
        return False
    return bool(min(-model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]) >= _ENDLESS)


def _axis(model: Any, data: Any, joint: Any) -> Any:
    """Return the axis of a revolute joint in the world (3,)."""
    pin.computeJointJacobians(model, data, pin.neutral(model))
    return data.J.reshape(6, -1, order="F")[3:, joint.idx_vExtended]
