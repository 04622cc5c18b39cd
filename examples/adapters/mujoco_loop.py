"""A Panda in MuJoCo at 500 Hz: servos that lag, encoders with delay and noise, a ball and a camera that are late."""

from collections import deque
from pathlib import Path

import mujoco
import numpy as np

from qpavoid import Avoidance, Controller, Obstacle, Points, Pose, Robot, build_scene, build_tasks
from qpavoid.adapters.mujoco import MujocoRobot
from qpavoid.adapters.mujoco_scene import camera_points, obstacles_of
from qpavoid.config import PointCloud, PostureTask, Task

robot, dt, lag, late, rng = Robot.load("panda"), 0.002, 0.03, 0.06, np.random.default_rng(0)
spec = mujoco.MjSpec.from_file(str(robot.urdf))  # or `MjModel.from_xml_path` of a scene of yours
for mesh in spec.meshes:
    mesh.file = str(robot.urdf.parents[1] / "meshes" / "collision" / Path(mesh.file).name)
spec.compiler.fusestatic = False  # links without a joint stay bodies, and keep their names
spec.option.timestep, spec.option.integrator = 0.001, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
spec.option.gravity, spec.option.disableflags = [0.0, 0.0, 0.0], mujoco.mjtDisableBit.mjDSBL_CONTACT
for name in robot.joint_names:
    servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=1e4, kv=1e4 * lag)  # it follows a setpoint by kv/kp late
    spec.joint(name).armature = 1e4 * (0.5 * lag) ** 2
ball = spec.worldbody.add_body(name="ball", mocap=True, pos=[1.2, 0.0, 0.5])
ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.06, 0.0, 0.0])
board = spec.worldbody.add_body(name="board", pos=[0.45, -0.35, 0.4])
board.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.01, 0.2])
spec.worldbody.add_camera(name="camera", pos=[1.2, 0.8, 0.8], xyaxes=[-0.6, 0.8, 0.0, -0.3, -0.2, 0.9], fovy=50)
model = spec.compile()
data = mujoco.MjData(model)
data.qpos[:7] = robot.home
mujoco.mj_forward(model, data)

balls = obstacles_of(model, data, ["ball"], uncertainty=0.01)
cloud = Obstacle.at("camera", PointCloud(resolution=0.02), [0.0, 0.0, 0.0])
tasks = build_tasks([Task(frame="panda_hand_tcp", type="pose"), PostureTask(weight=1e-3)], robot, robot.home)
avoidance, sensed = Avoidance(d1=0.03, d2=0.3), lag + 2 * dt  # 0.6 m/s, known 0.1 s late; late encoders count as lag
controller = Controller(build_scene(robot, [*balls, cloud]), tasks, dt=dt, avoidance=avoidance, latency=sensed)
plug = MujocoRobot(controller, model, ["ball"])

encoders, pictures, closest, ends = deque(maxlen=3), deque(), np.inf, np.empty(6)
geoms = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == model.body("panda_link0").id]
for k in range(1500):
    t = k * dt
    encoders.append(plug.q(data) + 1e-4 * rng.normal(size=7))
    if k % 16 == 0:  # 30 Hz: each picture arrives later, when it is an old one
        points = camera_points(model, data, "camera", ["panda_link0", "ball"])
        seen = {"ball": Pose.at(data.mocap_pos[0] + 0.002 * rng.normal(size=3), t=t), "camera": Points(points, t=t)}
        pictures.append((t + late, seen))
    news = pictures.popleft()[1] if pictures and pictures[0][0] <= t else None
    target = [0.4, -0.3 * np.sin(t), 0.45]  # it leads into the board
    plug.command(data, controller.step(encoders[0], t, {"panda_hand_tcp": target}, news).v)
    data.mocap_pos[0] = [max(1.2 - 0.6 * t, 0.3), 0.0, 0.5]
    mujoco.mj_step(model, data, 2)
    for other in (model.ngeom - 1, model.ngeom - 2) if k % 5 == 0 else ():
        closest = min(closest, *(mujoco.mj_geomDistance(model, data, g, other, 1.0, ends) for g in geoms))
print(f"closest {1e3 * closest:.1f} mm by MuJoCo")
