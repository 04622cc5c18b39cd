"""Proof that a target cannot be attained: it lies farther away than the arm is long, or inside an obstacle."""

from __future__ import annotations

import numpy as np

from qpavoid.control.tasks import FrameTask
from qpavoid.model.robot import Robot
from qpavoid_bench.arena.families.reach import arm, clearance
from qpavoid_bench.arena.world import World


def out_of_reach(world: World, task: FrameTask, t: float, tolerance: float) -> str:
    """Prove that a target cannot be attained, in words; return "" where that is not certain.

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
    enough = _shell(robot, task.frame_id) + tolerance
    for geometry, number in zip(world.scene.geometry.geometryObjects, world.scene.obstacle_of, strict=True):
        if number >= 0 and not world.scene.obstacles[number].moves:
            depth = -clearance(target, [(geometry.geometry, geometry.placement)])
            if depth > enough:
                return f"{frame}: its goal is {1e3 * depth:.0f} mm inside {world.scene.obstacle_names[number]!r}"
    return ""


def _shell(robot: Robot, frame_id: int) -> float:
    """Return the distance of a frame's origin from the nearest body that moves with it [m].

    It is inf if there is none.
    """
    frame = robot.model.frames[frame_id]
    mates = [body for body in robot.bodies.geometryObjects if body.parentJoint == frame.parentJoint]
    return max(clearance(frame.placement.translation, [(body.geometry, body.placement) for body in mates]), 0.0)
