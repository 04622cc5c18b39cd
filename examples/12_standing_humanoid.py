"""A G1 that stands on its torques: two feet, a ball past which it reaches, and a push, with MuJoCo as the robot."""

import numpy as np

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_contacts, build_scene, build_tasks
from qpavoid.config import Beta, ComTask, Contact, Dynamics, PlantSettings, PostureTask, Push, Sphere, Task
from qpavoid.run.torque_plant import TorquePlant

dt, hand, feet = 1e-3, "right_rubber_hand", ("left_ankle_roll_link", "right_ankle_roll_link")
corners = [(-0.05, 0.025, -0.035), (-0.05, -0.025, -0.035), (0.12, 0.03, -0.035), (0.12, -0.03, -0.035)]
robot = Robot.load("g1")
contacts = build_contacts([Contact(frame=foot, vertices=corners, friction=0.5) for foot in feet], robot, robot.home)
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), [0.26, -0.22, 0.0])])
tasks = build_tasks(
    [
        Task(frame=hand, gain=3.0),
        Task(frame="pelvis", type="orientation", orientation_weight=0.3, gain=3.0),
        ComTask(gain=3.0),
        PostureTask(weight=0.01, gain=2.0),
    ],
    robot,
    robot.home,
)
controller = Controller(
    scene, tasks, "qp", dt, Avoidance(d1=0.015, d2=0.08, row=Beta(near_speed=10.0)), contacts=contacts,
    dynamics=Dynamics(tracking_rate=60.0, row_rate=300.0, armature=0.01),
)  # fmt: skip

# friction, masses that are 10 % off, and 60 N at the pelvis, none of which the controller knows
push = Push(frame="pelvis", force=(0.0, 60.0, 0.0), start=1.5)
motors = PlantSettings(armature=0.01, friction=0.1, damping=0.1, mass_scale=1.1, pushes=[push])
plant = TorquePlant(robot, robot.home, motors, [(foot, np.array(corners)) for foot in feet])
start, way = np.array([0.07, -0.28, -0.07]), np.array([0.28, 0.12, 0.20])

closest, strongest = np.inf, 0.0
for k in range(2500):
    q, v = plant.measure()  # your robot goes here: what its encoders and its base's estimator say,
    target = Sample.at(start + min(k / 1500, 1.0) * way)
    tick = controller.tick(q, k * dt, {hand: target}, v=v)
    plant.apply(tick.solution.torque, dt)  # and what its motors take
    strongest = max(strongest, float(np.max(np.abs(tick.solution.torque) / plant.torque_limit)))
    closest = min(closest, tick.proximity.distance.min(initial=np.inf))

print(f"closest {1e3 * closest:.1f} mm; strongest torque {100 * strongest:.0f} % of its limit")
print(f"feet slipped by {1e3 * plant.slip().max():.1f} mm, and bear", end="")
print(*[f" {tick.solution.forces[foot][:, 2].sum():.0f} N ({foot.split('_')[0]})" for foot in feet], sep=",")
