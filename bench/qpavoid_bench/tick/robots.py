"""The robots of the benchmark: which model, pose, joints and links, and capsules fitted once to their collision meshes.

The capsules are kept in capsules/*.json, so that a change of the fitting does not change the workloads.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import distribution
from pathlib import Path

from qpavoid import Robot
from qpavoid.config import Body

FITTED = Path(__file__).parent / "capsules"
ROBOTS_FOLDER = Path(
    str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots"))
)


@dataclass(frozen=True)
class RobotSpec:
    """A robot of example-robot-data, cut down to what the benchmark moves."""

    name: str
    urdf: str
    frames: tuple[str, ...]
    """Frames with a pose task."""
    tools: tuple[str, ...]
    """Links near which some obstacles are put."""
    home: dict[str, float]
    """Pose about which it swings [rad]."""
    lock: dict[str, float] = field(default_factory=dict)
    root_joint: str = "fixed"
    base_height: float = 0.0
    """Height of a floating base [m]."""
    swing: float = 0.3
    """Amplitude of each joint's swing [rad]."""


ROBOTS = {
    "panda": RobotSpec(
        "panda",
        "panda_description/urdf/panda.urdf",
        frames=("panda_hand_tcp",),
        tools=("panda_hand", "panda_leftfinger"),
        home={"panda_joint2": -0.785, "panda_joint4": -2.356, "panda_joint6": 1.571, "panda_joint7": 0.785},
        lock={"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04},
    ),
    "baxter": RobotSpec(
        "baxter",
        "baxter_description/urdf/baxter.urdf",
        frames=("left_gripper", "right_gripper"),
        tools=("left_hand_link", "right_hand_link"),
        home={
            "left_s0": -0.5, "left_s1": -0.6, "left_e1": 1.2, "left_w1": 0.8,
            "right_s0": 0.5, "right_s1": -0.6, "right_e1": 1.2, "right_w1": 0.8,
        },
        lock={
            "head_pan": 0.0,
            "l_gripper_l_finger_joint": 0.0, "l_gripper_r_finger_joint": 0.0,
            "r_gripper_l_finger_joint": 0.0, "r_gripper_r_finger_joint": 0.0,
        },
    ),
    "g1": RobotSpec(
        "g1",
        "g1_description/urdf/g1_29dof_rev_1_0.urdf",
        frames=("left_ankle_roll_link", "right_ankle_roll_link", "left_rubber_hand", "right_rubber_hand"),
        tools=("left_wrist_yaw_link", "right_wrist_yaw_link"),
        home={
            "left_hip_pitch_joint": -0.3, "left_knee_joint": 0.6, "left_ankle_pitch_joint": -0.3,
            "right_hip_pitch_joint": -0.3, "right_knee_joint": 0.6, "right_ankle_pitch_joint": -0.3,
            "left_hip_roll_joint": 0.15, "right_hip_roll_joint": -0.15,
            "left_shoulder_roll_joint": 0.4, "left_elbow_joint": 0.6,
            "right_shoulder_roll_joint": -0.4, "right_elbow_joint": 0.6,
        },
        root_joint="free_flyer",
        base_height=0.8,
        swing=0.15,
    ),
}  # fmt: skip


def load(spec: RobotSpec, disabled_pairs: Iterable[tuple[str, str]] = ()) -> Robot:
    """The robot with its fitted capsules, one body a link."""
    bodies = [Body(**body) for body in json.loads((FITTED / f"{spec.name}.json").read_text())]
    return Robot.from_urdf(
        ROBOTS_FOLDER / spec.urdf,
        name=spec.name,
        root_joint=spec.root_joint,
        bodies=bodies,
        lock=spec.lock,
        home=spec.home,
        disabled_pairs=list(disabled_pairs),
    )
