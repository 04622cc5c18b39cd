"""Targets that certainly cannot be reached, known without a search: beyond the arm, or inside an obstacle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.control.distances import DistanceQuery
from qpavoid.model.kinematics import MIMIC, TRANSLATIONS
from qpavoid.model.robot import Robot
from qpavoid.model.scene import Scene
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


def target_violation(
    scene: Scene, query: DistanceQuery, frame_id: int, goal: Array, safety_distance: float
) -> tuple[float, int]:
    """Return by how much a target is too near to an obstacle for the bodies that move with the frame [m].

    With the frame's origin at the target, some point of a body is no farther from the target than the body is from that
    origin, however the frame is turned, and so no farther from the obstacle than both distances together.

    Args:
        scene: of the robot.
        query: present obstacle poses, and active pairs.
        frame_id: of the frame.
        goal: target (3,), world [m].
        safety_distance: between surfaces [m].

    Returns:
        The violation [m], not positive where nothing is certain, and the geometry of the obstacle, -1 if there is none.
        Point clouds are not considered.
    """
    frame, bodies = scene.robot.model.frames[frame_id], query.bodies
    joints = np.array([body.parentJoint for body in bodies], dtype=np.intp)
    first, second = scene.pairs.T
    free = (scene.obstacle_of[second] >= 0) & (joints[second] == 0)
    free &= ~np.isin(scene.obstacle_of[second], list(scene.clouds))
    active = query.enabled if query.disabled_pairs is None else query.enabled & ~query.disabled_pairs
    worst, obstacle = 0.0, -1
    from_origin: dict[int, float] = {}
    for a, b in scene.pairs[free & active & (joints[first] == frame.parentJoint)].tolist():
        if a not in from_origin:
            solid = bodies[a].geometry, bodies[a].placement
            from_origin[a] = max(clearance(frame.placement.translation, [solid]), 0.0)
        pose = query.poses[b]
        place = pin.SE3(pose[:9].reshape(3, 3).T, pose[9:])
        violation = safety_distance - from_origin[a] - clearance(goal, [(bodies[b].geometry, place)])
        if violation > worst:
            worst, obstacle = violation, b
    return worst, obstacle
