"""The robots of the benchmark: which model, pose, joints and links, and capsules fitted once to their collision meshes.

The capsules are kept in capsules/*.json, so that a change of the fitting does not change the workloads; run
`python -m bench.tick.robots` to fit them again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib.metadata import distribution
from itertools import groupby
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid import Robot
from qpavoid.config import Body, Capsule, Sphere
from qpavoid.geometry.capsules import fit_capsule

FITTED = Path(__file__).parent / "capsules"
SHARE = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")))


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
    skip: tuple[str, ...] = ()
    """Links without a body."""
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
        skip=("*_finger", "*_finger_tip", "*_visual"),
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
        skip=("logo_link", "head_link", "*_hip_pitch_link", "*_ankle_pitch_link", "*_shoulder_pitch_link",
              "*_wrist_roll_link", "*_wrist_pitch_link"),
        root_joint="free_flyer",
        base_height=0.8,
        swing=0.15,
    ),
}  # fmt: skip


def load(spec: RobotSpec, disabled_pairs: Iterable[tuple[str, str]] = ()) -> Robot:
    """The robot with its fitted capsules, one body a link."""
    bodies = [Body(**body) for body in json.loads((FITTED / f"{spec.name}.json").read_text())]
    return Robot.from_urdf(
        SHARE / spec.urdf,
        name=spec.name,
        root_joint=spec.root_joint,
        bodies=bodies,
        lock=spec.lock,
        home=spec.home,
        disabled_pairs=list(disabled_pairs),
    )


def fit(spec: RobotSpec) -> list[dict[str, Any]]:
    """One capsule for each link: around each piece of its collision geometry, then around those of the link."""
    robot = Robot.from_urdf(SHARE / spec.urdf, root_joint=spec.root_joint, bodies="capsule")
    frames = robot.model.frames

    def link(piece: Any) -> str:
        return str(frames[piece.parentFrame].name)

    bodies = []
    for name, pieces in groupby(robot.bodies.geometryObjects, key=link):
        if any(fnmatchcase(name, pattern) for pattern in spec.skip):
            continue
        group = list(pieces)
        to_link = frames[group[0].parentFrame].placement.inverse()
        if len(group) == 1:
            shape, placement = group[0].geometry, to_link * group[0].placement
        else:
            fitted = fit_capsule(
                np.concatenate([_surface(piece.geometry, to_link * piece.placement) for piece in group])
            )
            shape = coal.Capsule(fitted.radius, fitted.length) if fitted.length > 0 else coal.Sphere(fitted.radius)
            placement = pin.SE3(fitted.rotation, fitted.center)
        round_ball = isinstance(shape, coal.Sphere)
        config = (
            Sphere(radius=shape.radius) if round_ball else Capsule(radius=shape.radius, length=2 * shape.halfLength)
        )
        bodies.append(
            Body(
                name=name,
                frame=name,
                shape=config,
                position=tuple(placement.translation),
                rpy=tuple(pin.rpy.matrixToRpy(placement.rotation)),
            ).model_dump(mode="json")
        )
    return bodies


def _surface(shape: Any, placement: Any) -> Any:
    """Points on the caps of a capsule or a sphere (n, 3)."""
    i = np.arange(200) + 0.5
    z, angle = 1.0 - i / 100.0, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    ball = shape.radius * np.column_stack((r * np.cos(angle), r * np.sin(angle), z))
    half = getattr(shape, "halfLength", 0.0) * np.array([0.0, 0.0, 1.0])
    return np.concatenate((ball + half, ball - half)) @ placement.rotation.T + placement.translation


if __name__ == "__main__":
    for each in ROBOTS.values():
        fitted_bodies = fit(each)
        (FITTED / f"{each.name}.json").write_text(json.dumps(fitted_bodies, indent=1) + "\n")
        print(f"{each.name}: {len(fitted_bodies)} bodies")
