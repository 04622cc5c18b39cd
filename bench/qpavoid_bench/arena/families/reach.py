"""Bounds on what an arm can reach: the length of its links, and the distance of a point from solids."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.model.kinematics import MIMIC, TRANSLATIONS
from qpavoid.model.robot import Robot
from qpavoid.problem import Array

_POINT = coal.Sphere(1e-6)


def arm(robot: Robot, frame_id: int, first: int = 1) -> tuple[Array, float]:
    """Return the root (3,) of the chain of joints that moves a frame, at home, and the sum of its link lengths [m].

    Args:
        robot: its joints may turn or slide; with others, such as a floating base, or mimics, the length is infinite.
        frame_id: of the frame.
        first: first joint of the chain, counted from 1.
    """
    model, data = robot.model, robot.model.createData()
    frame = model.frames[frame_id]
    chain = list(model.supports[frame.parentJoint])[first:]
    if not chain:
        return np.array(frame.placement.translation), 0.0
    pin.forwardKinematics(model, data, robot.home)
    length = float(np.linalg.norm(frame.placement.translation))
    for place, i in enumerate(chain):
        joint = model.joints[i]
        length += float(np.linalg.norm(model.jointPlacements[i].translation)) if place else 0.0
        translations = TRANSLATIONS.get(joint.shortname(), 0)
        if translations > 1 or joint.shortname() == MIMIC:
            length = np.inf
        elif translations:
            length += max(abs(model.lowerPositionLimit[joint.idx_q]), abs(model.upperPositionLimit[joint.idx_q]))
    root = data.oMi[model.parents[chain[0]]].act(model.jointPlacements[chain[0]].translation)
    return np.array(root), length


def clearance(point: Array, solids: Iterable[tuple[Any, Any]]) -> float:
    """Return the distance of a point (3,) from the nearest of some shapes [m]: negative inside, inf without any.

    Args:
        point: in the frame of the poses.
        solids: coal shapes, and their poses as pinocchio has them.
    """
    at_point, request = coal.Transform3s(np.eye(3), point), coal.DistanceRequest()
    distances = [
        coal.distance(
            _POINT, at_point, shape, coal.Transform3s(pose.rotation, pose.translation), request, coal.DistanceResult()
        )
        for shape, pose in solids
    ]
    return float(min(distances, default=np.inf))
