"""Keep clear of what a depth camera sees: points that come in at 20 Hz, while the tick runs at 200 Hz."""

import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Points, Robot, Sample, build_scene, build_tasks
from qpavoid.config import HalfSpace, PointCloud, PostureTask, Task

robot = Robot.load("panda")
q = robot.home.copy()
cloud = Obstacle.at("camera", PointCloud(resolution=0.02), [0, 0, 0])  # points are in world axes here
ground = Obstacle.at("ground", HalfSpace(), [0, 0, 0])
tasks = build_tasks([Task(frame="panda_hand_tcp"), PostureTask(weight=1e-3)], robot, q)
controller = Controller(build_scene(robot, [cloud, ground]), tasks, dt=0.005, avoidance=Avoidance(d1=0.02, d2=0.12))


def picture(t: float) -> np.ndarray:
    """10 000 points on a board that is carried past; a camera sees some of them as NaN."""
    rng = np.random.default_rng(int(1000 * t))
    points = rng.uniform([-0.01, -0.15, 0.0], [0.01, 0.15, 0.9], (10_000, 3)) + np.array([0.48, 0.6 - 0.1 * t, 0.0])
    points[:50] = np.nan
    return points


start, closest, said = np.array([0.307, 0.0, 0.487]), np.inf, set()
for k in range(1600):
    t = k * controller.dt
    target = Sample.at(start + np.array([0.15 * np.sin(t), 0.15 * np.sin(2 * t), 0.0]))
    seen = {"camera": Points(picture(t))} if k % 10 == 0 else None  # pictures in between are not needed
    tick = controller.tick(q, targets={"panda_hand_tcp": target}, obstacles=seen)
    said |= set(map(str, tick.solution.assumptions))
    closest = tick.proximity.distance.min(initial=closest)
    q = pin.integrate(robot.model, q, tick.solution.v * controller.dt)  # your robot goes here

print(f"closest {1e3 * closest:.1f} mm, {tick.solution.status.value}; {', '.join(said)}")
