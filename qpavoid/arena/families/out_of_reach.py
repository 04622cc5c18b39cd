"""Proof that a target cannot be attained: it lies farther away than the arm is long, or inside an obstacle."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from qpavoid.arena.families.room import gap, placed
from qpavoid.arena.world import World
from qpavoid.problem import Array
from qpavoid.robot import Robot
from qpavoid.tasks import FrameTask

_POINT = coal.Sphere(1e-6)


def out_of_reach(world: World, task: FrameTask, t: float, tolerance: float) -> str:
    """Why a target cannot be attained, in words; empty where that is not certain.

    Args:
        world: where the task is.
        task: of a frame.
        t: when its target counts [s].
        tolerance: how near would do [m].
    """
    robot, frame, target = world.scene.robot, task.settings.frame, task.motion.sample(t).position
    root, length = arm(robot, task.frame_id)
    beyond = float(np.linalg.norm(target - root)) - length - tolerance
    if beyond > 0.0:
        return f"{frame}: its goal is {1e3 * beyond:.0f} mm farther away than all links in a row are long"
    here = coal.Transform3s(np.eye(3), target)
    enough = _shell(robot, task.frame_id) + tolerance
    for geometry, number in zip(world.scene.geometry.geometryObjects, world.scene.obstacle_of, strict=True):
        if number >= 0 and not world.scene.obstacles[number].moves:
            depth = -gap(_POINT, here, [placed(geometry)])
            if depth > enough:
                return f"{frame}: its goal is {1e3 * depth:.0f} mm inside {world.scene.obstacle_names[number]!r}"
    return ""


def arm(robot: Robot, frame_id: int, first: int = 1) -> tuple[Array, float]:
    """Where the chain of joints that moves a frame begins at home (3,), and how long its links are in a row [m].

    Args:
        robot: whose joints have one coordinate each.
        frame_id: of the frame.
        first: which joint of the chain it begins with, counted from 1.
    """
    model, data = robot.model, robot.model.createData()
    frame = model.frames[frame_id]
    chain = list(model.supports[frame.parentJoint])[first:]
    pin.forwardKinematics(model, data, robot.home)
    length = float(np.linalg.norm(frame.placement.translation))
    for place, i in enumerate(chain):
        joint = model.joints[i]
        length += float(np.linalg.norm(model.jointPlacements[i].translation)) if place else 0.0
        if joint.shortname().startswith("JointModelP"):
            length += max(abs(model.lowerPositionLimit[joint.idx_q]), abs(model.upperPositionLimit[joint.idx_q]))
    return np.array(data.oMi[chain[0]].translation), length


def _shell(robot: Robot, frame_id: int) -> float:
    """How far a frame's origin is from the nearest body that moves with it [m]; inf if there is none."""
    frame = robot.model.frames[frame_id]
    mates = [placed(body) for body in robot.bodies.geometryObjects if body.parentJoint == frame.parentJoint]
    return max(gap(_POINT, coal.Transform3s(np.eye(3), frame.placement.translation), mates), 0.0)
