"""What the ROS 2 node does, without ROS: the messages of a joystick, a camera and the drives, one after the other.

With ROS 2: `ros2 launch examples/adapters/ros2_filter.launch.xml scenario:=scene.yaml`.
"""

import tempfile
from pathlib import Path

import numpy as np

from qpavoid import Avoidance, Controller, Pose, build_scene
from qpavoid.adapters.ros2 import NodeLogic

SCENARIO = """
robot: panda
dt: 0.01
duration: 1.0
tasks: [{type: posture}]
avoidance: {d1: 0.03, d2: 0.15}
obstacles:
- {name: ball, source: external, shape: {type: sphere, radius: 0.06}, motion: {type: fixed, position: [0.3, 0.3, 0.5]}}
"""
path = Path(tempfile.mkdtemp()) / "scene.yaml"
path.write_text(SCENARIO)
node = NodeLogic(str(path), mode="filter")
robot = node.controller.scene.robot
onlooker = Controller(build_scene(robot, node.controller.scene.obstacles), [], avoidance=Avoidance(d1=0.03, d2=0.5))
q, names, closest, said = robot.home.copy(), [*reversed(robot.joint_names), "finger"], np.inf, ""
for k in range(500):
    t, place = 0.01 * k, [0.3, 0.3 - 0.0002 * k, 0.5]
    node.joint_state(names, [*q[::-1], 0.02], t)  # /joint_states, in an order of its own
    if k % 3 == 0:
        node.obstacle("ball", place, [0.0, 0.0, 0.0, 1.0], t)  # /qpavoid/obstacles/ball
    if k < 400:  # then the joystick is silent: the robot stops
        node.desired([], 0.4 * np.eye(7)[0], t)  # /qpavoid/desired
    command = node.step(t)  # the timer
    q = q + 0.01 * command.velocities  # /qpavoid/velocity, or /qpavoid/trajectory: your robot goes here
    closest = onlooker.tick(q, t, obstacles={"ball": Pose.at(place)}).proximity.distance.min(initial=closest)
    if command.solution.status.value != said:
        said = command.solution.status.value
        print(f"{t:.2f} s: {said}", *map(str, command.solution.reasons))
print(f"closest {1e3 * closest:.1f} mm; at the end {np.abs(command.velocities).max():.3f} rad/s")
