"""A policy of LeRobot that knows nothing of what stands around: its actions filtered, and a chunk looked at ahead.

With LeRobot installed, the same filter is a step of its robot action pipeline.
"""

import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from qpavoid import Controller, Pose, load_scenario
from qpavoid.adapters.actions import ActionFilter

SCENARIO = """
robot: panda
dt: 0.0333
duration: 1.0
tasks: [{type: posture}]
avoidance: {d1: 0.03, d2: 0.15}
obstacles: [{name: ball, shape: {type: sphere, radius: 0.06}, motion: {type: fixed, position: [0.25, 0.25, 0.45]}}]
"""
path = Path(tempfile.mkdtemp()) / "scene.yaml"  # a file of yours
path.write_text(SCENARIO)
controller, q = Controller.from_scenario(load_scenario(str(path)))
names, home, ball = controller.scene.robot.joint_names, q.copy(), {"ball": Pose.at([0.25, 0.25, 0.45])}


def policy(k: int) -> np.ndarray:
    """Return a chunk of 60 actions: joint positions that swing the hand through the ball."""
    swing = 0.5 * (1.0 - np.cos(0.03 * np.arange(k, k + 60)))
    return home + np.outer(swing, [1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


safe, changed = ActionFilter(controller), 0
print(f"the first chunk cannot be followed from its action {safe.chunk(q, policy(0), ball).changed} on")
if find_spec("lerobot") is None:  # by hand: what the step of the pipeline does
    for k in range(200):
        q = safe(q, policy(k)[0], obstacles=ball)  # your robot goes here
        changed += np.abs(q - policy(k)[0]).max() > 1e-6
else:
    from lerobot.processor import RobotProcessorPipeline
    from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action

    from qpavoid.adapters.lerobot import SafetyFilterStep

    step = SafetyFilterStep(str(path))
    pipeline = RobotProcessorPipeline(  # the `robot_action_processor` of lerobot-record and others
        steps=[step], to_transition=robot_action_observation_to_transition, to_output=transition_to_robot_action
    )
    for k in range(200):
        step.obstacles.put("ball", ball["ball"])
        both = policy(k)[0], q
        action, observation = ({f"{n}.pos": float(v) for n, v in zip(names, np.rad2deg(x), strict=True)} for x in both)
        sent = pipeline((action, observation))
        q = np.deg2rad([sent[f"{name}.pos"] for name in names])
        changed += np.abs(q - policy(k)[0]).max() > 1e-6
print(f"{changed} of 200 actions were changed")
