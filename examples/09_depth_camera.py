"""Go round what a depth camera sees: MuJoCo's pictures at 15 Hz beside a loop at 100 Hz. `pip install mujoco` first."""

import os
import time

os.environ.setdefault("MUJOCO_GL", "egl")  # or osmesa: no display is needed

import mujoco
import numpy as np
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Robot, build_scene, build_tasks
from qpavoid.config import PointCloud, PostureTask, Sphere, Task
from qpavoid.perception.process import Perception
from qpavoid.perception.rendering import RenderedCamera
from qpavoid.run.mujoco import build

TCP = "panda_hand_tcp"
robot = Robot.load("panda")
q, start = robot.home.copy(), np.array([0.307, 0.0, 0.487])

# the world as it is: what the controller knows of it comes from the camera alone
world = build(build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.07), start + np.array([0.02, 0.2, 0.0]))]), q)
view = mujoco.MjvCamera()
view.lookat, view.distance, view.azimuth, view.elevation = [0.3, 0.1, 0.4], 1.5, 150.0, -25.0
rendered = RenderedCamera(world.model, world.data, view, size=(640, 480))

cloud = Obstacle.at("camera", PointCloud(resolution=0.02), [0, 0, 0], external=True)  # without pictures, it stops
tasks = build_tasks([Task(frame=TCP), PostureTask(weight=1e-3)], robot, q)
controller = Controller(build_scene(robot, [cloud]), tasks, dt=0.01, avoidance=Avoidance(d1=0.03, d2=0.12))
closest, stopped = np.inf, 0
balls = [i for i, pair in enumerate(world.scene.pair_names) if "ball" in pair]
with Perception(robot, rendered.camera, resolution=0.02, margin=0.02) as perception:
    begin = time.perf_counter()
    for k in range(500):
        t = k * controller.dt
        perception.record(q, t)
        world.place(q, t)
        if k % 7 == 0:
            perception.submit(rendered.depth(world.data), t)  # by the thread of your camera, with its time stamp
        points = perception.latest(t)
        target = start + np.array([0.0, min(0.15 * t, 0.4), 0.0])
        solution = controller.step(q, t, {TCP: target}, {"camera": points} if points else None)
        stopped += solution.status.value == "STOPPED"
        closest = min(closest, *map(world.distance, balls))
        q = pin.integrate(robot.model, q, solution.v * controller.dt)  # your robot goes here
        time.sleep(max(0.0, begin + t + controller.dt - time.perf_counter()))
    timing = perception.timing
rendered.close()

print(f"closest {1e3 * closest:.1f} mm; {timing.returned} of {timing.submitted} pictures; {stopped} steps stopped")
print(f"sorted in {1e3 * timing.sorting[0]:.1f} ms, used {1e3 * timing.latency[0]:.0f} ms after they were taken")
