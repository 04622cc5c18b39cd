"""Make any command safe: the velocity that comes back is the closest one that keeps clear, within the limits."""

import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Robot, build_scene
from qpavoid.config import Sphere

robot = Robot.load("panda")
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.08), [0.25, 0.25, 0.45])])
controller = Controller(scene, [], "qp", dt=0.01, avoidance=Avoidance(d1=0.03, d2=0.15))
onlooker = Controller(scene, [], "tracking", avoidance=Avoidance(d1=0.03, d2=0.5))  # only measures distances

q, closest, touched = robot.home.copy(), np.inf, 0
for k in range(600):
    command = np.array([0.4, 0.0, 0.0, 0.2 * np.sin(0.01 * k), 0.0, 0.0, 0.0])  # a stick, a policy, another IK
    solution = controller.filter(q, command)
    touched += not np.array_equal(solution.v, command)
    q = pin.integrate(robot.model, q, solution.v * controller.dt)  # your robot goes here
    closest = min(closest, onlooker.tick(q).proximity.distance.min(initial=np.inf))

print(f"closest {1e3 * closest:.1f} mm; {touched} of 600 commands were changed")
