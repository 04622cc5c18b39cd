"""Plan a collision-free path to a pose of the tool, and follow it through the QP, which keeps clear all the same."""

import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Robot, build_scene, make_planner
from qpavoid.config import Box, Sphere

robot = Robot.load("panda")
scene = build_scene(
    robot,
    [
        Obstacle.at("board", Box(size=(0.4, 0.8, 0.02)), [0.65, 0.0, 0.55]),
        Obstacle.at("side", Box(size=(0.4, 0.02, 0.5)), [0.65, 0.1, 0.5]),
        Obstacle.at("ball", Sphere(radius=0.08), [0.4, -0.4, 0.3]),
    ],
)
controller = Controller(scene, [], dt=0.01, avoidance=Avoidance(d1=0.02, d2=0.1))

planner = make_planner(controller)  # plan_to(controller, ...) does both in one call
path = planner.plan(robot.home, targets={"panda_hand_tcp": [0.55, -0.25, 0.45]})
if not path:
    raise SystemExit(str(path.reason))
print(f"{len(path.q)} configurations, {path.duration:.1f} s, d1 and {1e3 * path.clearance:.0f} mm more kept on the way")

q, closest = robot.home.copy(), np.inf
for k in range(int(path.duration / controller.dt) + 200):
    goal = path.at((k + 1) * controller.dt)
    solution = controller.filter(q, 10.0 * (goal - q))
    closest = min(closest, planner.clearance(q))
    q = pin.integrate(robot.model, q, solution.v * controller.dt)  # your robot goes here
print(f"{np.abs(q - path.q[-1]).max():.4f} rad from the goal, closest {1e3 * closest:.0f} mm")
