"""Pick a box up, carry it past a pole and put it down: while it is carried, it is a body of the robot."""

import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_scene, build_tasks
from qpavoid.config import Box, Capsule, PostureTask, Task

TCP = "panda_hand_tcp"
robot = Robot.load("panda")
q = robot.home.copy()
data = robot.model.createData()


def tool(q: np.ndarray) -> pin.SE3:
    """World pose of the tool."""
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(TCP)]


start = tool(q).translation.copy()
held = tool(q) * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.13]))  # between the fingers, hanging down
box = Obstacle.at("box", Box(size=(0.06, 0.06, 0.24)), held.translation, held.rotation, graspable=True)
pole = Obstacle.at("pole", Capsule(radius=0.025, length=0.16), start + np.array([0.02, 0.2, -0.16]))
controller = Controller(
    build_scene(robot, [box, pole]),
    build_tasks([Task(frame=TCP), PostureTask(weight=1e-3)], robot, q),
    dt=0.01,
    avoidance=Avoidance(d1=0.02, d2=0.12),
)
controller.attach("box", TCP, q)
closest = np.inf
for k in range(600):
    target = Sample.at(start + np.array([0.0, min(0.1 * k * controller.dt, 0.4), 0.0]))
    tick = controller.tick(q, targets={TCP: target})
    for pair, d in zip(tick.proximity.pair, tick.proximity.distance, strict=True):
        if controller.scene.pair_names[pair] == ("box", "pole"):
            closest = min(closest, d)
    q = pin.integrate(robot.model, q, tick.solution.v * controller.dt)  # your robot goes here
down = controller.release("box", q)
for _ in range(100):  # up and away: the box stays
    solution = controller.step(q, targets={TCP: Sample.at(tool(q).translation + np.array([0.0, 0.0, 0.1]))})
    q = pin.integrate(robot.model, q, solution.v * controller.dt)

print(f"box and pole: closest {1e3 * closest:.1f} mm; the box rests at {np.round(down.position, 3)}")
print(f"{1e3 * np.linalg.norm(tool(q).translation - down.position):.0f} mm from it, {solution.status.value}")
