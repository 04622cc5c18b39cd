"""OInK of roboplan with an obstacle that moves: its displacements filtered. Needs `qpavoid[adapters]`."""

import re

import numpy as np
from roboplan import core
from roboplan.optimal_ik import FrameTask, FrameTaskOptions, Oink, PositionLimit, VelocityLimit

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_scene
from qpavoid.adapters.roboplan import velocity_filter
from qpavoid.config import Sphere

robot, dt, tool = Robot.load("panda"), 0.01, "panda_hand_tcp"
urdf = re.sub(r"(?s)<(visual|collision)>.*?</\1>", "", robot.urdf.read_text())  # qpavoid keeps clear: no bodies here
scene = core.Scene("panda", core.loadUrdfSceneDescriptionFromXml(urdf))
obstacle_scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), [0.5, 0.0, 0.45])])
onlooker = Controller(obstacle_scene, [], "tracking", dt, avoidance=Avoidance(d1=0.03, d2=0.5))  # measures distances


def run(is_filtered: bool) -> float:
    """Move the hand to and fro, and a ball up and down across its way; return the least distance [m]."""
    controller = Controller(obstacle_scene, [], dt=dt, avoidance=Avoidance(d1=0.03, d2=0.15))
    safe, oink = velocity_filter(controller, scene), Oink(scene)
    q = scene.getCurrentJointPositions()
    q[scene.getJointPositionIndices(robot.joint_names)] = robot.home
    start, goal = scene.forwardKinematics(q, tool), core.CartesianConfiguration()
    goal.base_frame, goal.tip_frame, goal.tform = "panda_link0", tool, start
    task = FrameTask(oink, scene, goal, FrameTaskOptions(1.0, 0.5, 1.0, 0.01))
    speeds = np.full(oink.num_variables, 2.0)
    limits, delta_q, closest = (
        [PositionLimit(oink, 1.0), VelocityLimit(oink, dt, speeds)],
        np.zeros(len(speeds)),
        np.inf,
    )
    for k in range(600):
        t = k * dt
        ball = Sample.at([0.5, 0.0, 0.45 + 0.1 * np.sin(t)], linear=[0.0, 0.0, 0.1 * np.cos(t)])
        target = start.copy()
        target[:3, 3] += [0.1, 0.2 * np.sin(t), 0.0]
        task.setTargetFrameTransform(np.asfortranarray(target))
        oink.solveIk(q, [task], limits, [], delta_q, 1e-6)
        v = delta_q / dt
        if is_filtered:
            v = safe(q, v, obstacles={"ball": ball})
        q = scene.integrate(q, dt * v)
        seen = onlooker.tick(q[:7], obstacles={"ball": ball}).proximity.distance
        closest = min(closest, seen.min(initial=np.inf))
    return closest


print(f"its displacements filtered: closest {1e3 * run(True):.1f} mm")
print(f"roboplan alone: {1e3 * run(False):.1f} mm")
