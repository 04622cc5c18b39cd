"""Which links of a robot come close to what it grasps: those from the wrist on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

_MOST = 3
"""Joints that make a wrist, at most."""
_NEAR = 0.16
"""Distance of the origins of two joints of a wrist, as a share of the limb's length [-]: 0.12 in a Baxter, whose next
one is at 0.27, 0.07 in a UR5 and a Panda, whose next ones are at 0.3."""


def wrist_links(model: Any, end_effectors: Sequence[str]) -> set[str]:
    """Find the links that move with the wrists of some end effectors: wrist, hand, fingers.

    The wrist is the last joint before an end effector, and up to two before it whose origins follow each other closely.

    Args:
        model: pinocchio model.
        end_effectors: frames.
    """
    moved: set[int] = set()
    for name in end_effectors:
        frame = model.frames[model.getFrameId(name)]
        if frame.parentJoint:
            moved |= set(model.subtrees[_first_joint(model, frame)])
    return {str(frame.name) for frame in model.frames if frame.type == pin.BODY and frame.parentJoint in moved}


def _first_joint(model: Any, frame: Any) -> int:
    """Find the joint that a wrist begins with."""
    chain = [joint for joint in list(model.supports[frame.parentJoint])[1:] if model.names[joint] != "root_joint"]
    offsets = [float(np.linalg.norm(model.jointPlacements[joint].translation)) for joint in chain]
    length = sum(offsets[1:]) + float(np.linalg.norm(frame.placement.translation))
    first = len(chain) - 1
    while first > max(len(chain) - _MOST, 0) and offsets[first] <= _NEAR * length:
        first -= 1
    return int(chain[first]) if chain else 0
