"""mink with obstacles that move: its velocity filtered, then the same rows inside its QP. Needs `qpavoid[adapters]`."""

from pathlib import Path

import mink
import mujoco
import numpy as np

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_scene
from qpavoid.adapters.mink import AvoidanceLimit, solve_ik, velocity_filter
from qpavoid.config import Sphere

robot, dt, tool = Robot.load("panda"), 0.01, "panda_link7"
spec = mujoco.MjSpec.from_file(str(robot.urdf))  # or any MJCF that names its joints as the URDF does
for mesh in spec.meshes:
    mesh.file = str(robot.urdf.parents[1] / "meshes" / "collision" / Path(mesh.file).name)
model = spec.compile()
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), [0.5, 0.0, 0.45])])
avoidance = Avoidance(d1=0.03, d2=0.15)
onlooker = Controller(scene, [], "tracking", dt, avoidance=Avoidance(d1=0.03, d2=0.5))  # only measures distances


def run(way: str) -> float:
    """Move the hand to and fro, and a ball up and down across its way; return the least distance [m]."""
    configuration = mink.Configuration(model, np.append(robot.home, [0.02, 0.02]))
    task, posture = mink.FrameTask(tool, "body", 1.0, 0.5), mink.PostureTask(model, 1e-3)
    posture.set_target_from_configuration(configuration)
    start = configuration.get_transform_frame_to_world(tool, "body")
    controller = Controller(scene, [], dt=dt, avoidance=avoidance)
    safe, limit = velocity_filter(controller, configuration), AvoidanceLimit(controller, configuration)
    closest = np.inf
    for k in range(600):
        t = k * dt
        ball = Sample.at([0.5, 0.0, 0.45 + 0.1 * np.sin(t)], linear=[0.0, 0.0, 0.1 * np.cos(t)])
        shift = mink.SE3.from_translation(np.array([0.1, 0.2 * np.sin(t), 0.0]))
        task.set_target(shift.multiply(start))
        if way == "rows":
            limit.obstacles = {"ball": ball}
            v = solve_ik(configuration, [task, posture], dt, limit)
        else:
            v = mink.solve_ik(configuration, [task, posture], dt, solver="daqp")
        if way == "filter":
            v = safe(configuration.q, v, obstacles={"ball": ball})
        configuration.integrate_inplace(v, dt)
        seen = onlooker.tick(configuration.q[:7], obstacles={"ball": ball}).proximity.distance
        closest = min(closest, seen.min(initial=np.inf))
    return closest


for way, what in (("filter", "its velocity filtered"), ("rows", "rows inside its QP")):
    print(f"{what}: closest {1e3 * run(way):.1f} mm")
print(f"mink alone: {1e3 * run('alone'):.1f} mm")
