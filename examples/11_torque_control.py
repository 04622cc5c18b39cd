"""A Panda with torque motors: the same controller with a `dynamics` block, and MuJoCo in place of the robot."""

import numpy as np

from qpavoid import Avoidance, Controller, Obstacle, Pose, Robot, build_scene, build_tasks
from qpavoid.config import Beta, Dynamics, PlantSettings, PostureTask, Sphere, Task
from qpavoid.run.torque_plant import TorquePlant

dt, robot = 1e-3, Robot.load("panda")
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), [0.45, 0.0, 0.55])])
tasks = build_tasks([Task(frame="panda_hand_tcp", gain=4.0), PostureTask(weight=1e-3)], robot, robot.home)
controller = Controller(
    scene, tasks, "qp", dt, Avoidance(d1=0.03, d2=0.15, row=Beta(near_speed=10.0)), dynamics=Dynamics(armature=0.1)
)
onlooker = Controller(scene, [], "tracking", avoidance=Avoidance(d1=0.03, d2=0.5))  # only measures distances

# friction, masses that are 20 % off and 1 ms of delay, none of which the controller knows
motors = PlantSettings(armature=0.1, friction=0.3, damping=0.5, mass_scale=1.2, delay=1e-3)
plant = TorquePlant(robot, robot.home, motors)
side = [Pose([0.45, y, 0.55], np.diag([1.0, -1.0, -1.0])) for y in (0.35, -0.35)]

closest, strongest = np.inf, 0.0
for k in range(4000):
    q, v = plant.measure()  # your robot goes here: what its encoders say,
    solution = controller.step(q, k * dt, {"panda_hand_tcp": side[k // 2000]}, v=v)
    plant.apply(solution.torque, dt)  # and what its motors take
    strongest = max(strongest, float(np.max(np.abs(solution.torque) / robot.torque_limits())))
    closest = min(closest, onlooker.tick(plant.q).proximity.distance.min(initial=np.inf))

print(f"closest {1e3 * closest:.1f} mm; strongest torque {100 * strongest:.0f} % of its limit")
