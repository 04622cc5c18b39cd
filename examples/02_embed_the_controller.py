"""Embed the controller in a loop of your own: targets and obstacles come from your program, tick by tick."""

import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_scene, build_tasks
from qpavoid.config import PostureTask, Sphere, Task

robot = Robot.load("panda")
q = robot.home.copy()
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.08), [0.75, 0.0, 0.5])])
# the light posture holds the elbow, which a tool alone leaves free to drift
tasks = build_tasks([Task(frame="panda_hand_tcp"), PostureTask(weight=1e-3)], robot, q)
controller = Controller(scene, tasks, "qp", dt=0.005, avoidance=Avoidance(d1=0.03, d2=0.15))

start = np.array([0.307, 0.0, 0.487])
closest = np.inf
for k in range(1600):
    t = k * controller.dt
    target = Sample.at(start + np.array([0.1 * np.sin(t), 0.15 * np.sin(2 * t), 0.0]))
    ball_now = Sample.at([0.75 - 0.06 * t, 0.0, 0.5], linear=[-0.06, 0.0, 0.0])
    tick = controller.tick(q, targets={"panda_hand_tcp": target}, obstacles={"ball": ball_now})
    closest = tick.proximity.distance.min(initial=closest)
    q = pin.integrate(robot.model, q, tick.solution.v * controller.dt)  # your robot goes here

print(f"closest {1e3 * closest:.1f} mm, {tick.solution.status.value}")
