"""Pink with obstacles that move: its velocity filtered, then the same rows inside its QP. Needs `qpavoid[adapters]`."""

import numpy as np
import pink
import pinocchio as pin

from qpavoid import Avoidance, Controller, Obstacle, Robot, Sample, build_scene
from qpavoid.adapters.pink import AvoidanceLimit, solve_ik, velocity_filter
from qpavoid.config import Sphere

robot, dt = Robot.load("panda"), 0.01
model = pin.buildModelFromUrdf(str(robot.urdf))  # Pink's, with two finger joints that qpavoid's has locked
scene = build_scene(robot, [Obstacle.at("ball", Sphere(radius=0.06), [0.5, 0.0, 0.45])])
avoidance = Avoidance(d1=0.03, d2=0.15)
onlooker = Controller(scene, [], "tracking", dt, avoidance=Avoidance(d1=0.03, d2=0.5))  # only measures distances


def run(way: str) -> float:
    """Move the hand to and fro, and a ball up and down across its way; return the least distance [m]."""
    configuration = pink.Configuration(model, model.createData(), np.append(robot.home, [0.02, 0.02]))
    task, posture = pink.FrameTask("panda_hand_tcp", 1.0, 0.5), pink.PostureTask(cost=1e-3)
    posture.set_target_from_configuration(configuration)
    start = configuration.get_transform_frame_to_world("panda_hand_tcp")
    controller = Controller(scene, [], dt=dt, avoidance=avoidance)
    safe, limit = velocity_filter(controller, configuration), AvoidanceLimit(controller, configuration)
    closest = np.inf
    for k in range(600):
        t = k * dt
        ball = Sample.at([0.5, 0.0, 0.45 + 0.1 * np.sin(t)], linear=[0.0, 0.0, 0.1 * np.cos(t)])
        target = start.copy()
        target.translation += [0.1, 0.2 * np.sin(t), 0.0]
        task.set_target(target)
        if way == "rows":
            limit.obstacles = {"ball": ball}
            v = solve_ik(configuration, [task, posture], dt, limit)
        else:
            v = pink.solve_ik(configuration, [task, posture], dt, solver="daqp", safety_break=False)
        if way == "filter":
            v = safe(configuration.q, v, obstacles={"ball": ball})
        configuration.integrate_inplace(v, dt)
        seen = onlooker.tick(configuration.q[:7], obstacles={"ball": ball}).proximity.distance
        closest = min(closest, seen.min(initial=np.inf))
    return closest


for way, what in (("filter", "its velocity filtered"), ("rows", "rows inside its QP")):
    print(f"{what}: closest {1e3 * run(way):.1f} mm")
print(f"Pink alone: {1e3 * run('alone'):.1f} mm")
