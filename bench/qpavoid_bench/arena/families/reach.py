"""Reach of an arm, and proof that a target lies farther away than the arm is long, or inside an obstacle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.control.tasks import FrameTask
from qpavoid.model.kinematics import MIMIC, turning_columns
from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid_bench.arena.families.inverse_kinematics import FrameGoal, JointRanges, solve_inverse_kinematics
from qpavoid_bench.arena.world import World

_POINT = coal.Sphere(1e-6)


def chain(robot: Robot, frame_id: int, first: int = 1) -> tuple[Array, float]:
    """Return the root (3,) of the chain of joints that moves a frame, at home, and the sum of its link lengths [m].

    Args:
        robot: its joints may turn or slide; with others, such as a floating base, or mimics, the length is infinite.
        frame_id: of the frame.
        first: first joint of the chain, counted from 1.
    """
    model, data = robot.model, robot.model.createData()
    frame = model.frames[frame_id]
    joints = list(model.supports[frame.parentJoint])[first:]
    if not joints:
        return np.array(frame.placement.translation), 0.0
    pin.forwardKinematics(model, data, robot.home)
    length, turns = float(np.linalg.norm(frame.placement.translation)), turning_columns(model)
    for place, i in enumerate(joints):
        joint = model.joints[i]
        length += float(np.linalg.norm(model.jointPlacements[i].translation)) if place else 0.0
        own = slice(joint.idx_vExtended, joint.idx_vExtended + joint.nvExtended)
        translations = int((~turns[own]).sum())
        if translations > 1 or joint.shortname() == MIMIC:
            length = np.inf
        elif translations:
            length += max(abs(model.lowerPositionLimit[joint.idx_q]), abs(model.upperPositionLimit[joint.idx_q]))
    root = data.oMi[model.parents[joints[0]]].act(model.jointPlacements[joints[0]].translation)
    return np.array(root), length


def out_of_reach(world: World, task: FrameTask, t: float, tolerance: float) -> str:
    """Prove that a target cannot be attained, in words; return "" where that is not certain.

    Args:
        world: where the task is.
        task: of a frame.
        t: when its target counts [s].
        tolerance: how near would do [m].
    """
    robot, frame, target = world.scene.robot, task.settings.frame, task.motion.sample(t).position
    root, length = chain(robot, task.frame_id)
    beyond = float(np.linalg.norm(target - root)) - length - tolerance
    if beyond > 0.0:
        return f"{frame}: its goal is {1e3 * beyond:.0f} mm farther away than all links in a row are long"
    enough = _shell(robot, task.frame_id) + tolerance
    for geometry, number in zip(world.scene.geometry.geometryObjects, world.scene.obstacle_of, strict=True):
        if number >= 0 and not world.scene.obstacles[number].moves:
            depth = -_clearance(target, [(geometry.geometry, geometry.placement)])
            if depth > enough:
                return f"{frame}: its goal is {1e3 * depth:.0f} mm inside {world.scene.obstacle_names[number]!r}"
    return ""


def is_reachable(robot: Robot, tool: str, position: Array, tolerance: float = 1e-3) -> bool:
    """Return whether a search finds a configuration with a tool's frame at a position (3,), whatever stands there."""
    ranges, random = JointRanges.of(robot), np.random.default_rng(0)
    goals = [FrameGoal(robot.frame_id(tool, "tool"), np.asarray(position))]
    starts = [robot.home, *random.uniform(ranges.lower, ranges.upper, (2, len(robot.home)))]
    return any(solve_inverse_kinematics(robot, goals, q, ranges, tolerance) is not None for q in starts)


def _shell(robot: Robot, frame_id: int) -> float:
    """Return the distance of a frame's origin from the nearest body that moves with it [m].

    It is inf if there is none.
    """
    frame = robot.model.frames[frame_id]
    mates = [body for body in robot.bodies.geometryObjects if body.parentJoint == frame.parentJoint]
    return max(_clearance(frame.placement.translation, [(body.geometry, body.placement) for body in mates]), 0.0)


def _clearance(point: Array, solids: Iterable[tuple[Any, Any]]) -> float:
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
