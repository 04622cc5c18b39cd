"""Joints as `robot check` reports them, and what is wrong with their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid.config import RobotConfig
from qpavoid.model.kinematics import MIMIC
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.urdf import is_mjcf
from qpavoid.model.xml_file import read_robot_xml
from qpavoid.setup.joints import ENDLESS, joint_kind, mimics

_MAX_SPEED = {"revolute": 50.0, "continuous": 50.0, "prismatic": 10.0}
"""Speed limits above which one is probably an error [rad/s, m/s]."""
_MAX_RANGE = {"revolute": 8.0 * math.pi, "prismatic": 20.0}
"""Ranges above which one is probably an error [rad, m]."""
_MIN_RANGE = 1e-3
"""Range below which a joint is better locked [rad, m]."""


@dataclass(frozen=True)
class Joint:
    """A joint as the file has it, with the limits that hold."""

    name: str
    kind: str
    """`fixed`, `revolute`, `continuous`, `prismatic`, `planar`, `floating` or `spherical`."""
    mimics: str | None = None
    lower: float | None = None
    """[rad or m]; None: no limit."""
    upper: float | None = None
    velocity: float | None = None
    """[rad/s or m/s]; None: no limit."""
    locked: bool = False
    led: bool = False
    """It moves with the joint that it mimics, and has no coordinate of its own."""


def list_joints(urdf: Path, model: Any, config: RobotConfig, whole: Any) -> list[Joint]:
    """List all joints: those that move, with the limits in force, locked and fixed ones.

    Args:
        urdf: the file.
        model: pinocchio model of the robot as it loads.
        config: its configuration.
        whole: model of the file.
    """
    leaders = {name: leader for name, (leader, _, _) in mimics(urdf).items()}
    elements = [] if is_mjcf(urdf) else read_robot_xml(urdf, "URDF").findall("joint")
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in elements}
    joints = []
    for name, joint in zip(list(whole.names)[1:], list(whole.joints)[1:], strict=True):
        is_follower, leader = joint.shortname() == MIMIC, leaders.get(name)
        kind = kinds[name] if is_follower else joint_kind(joint)
        is_locked = name in config.lock or (is_follower and leader in config.lock)
        if is_locked or is_follower or not model.existJointName(name):  # the latter: its limits leave it no range
            is_led = is_follower and not is_locked
            joints.append(Joint(name, kind, leader, locked=not is_led, led=is_led))
            continue
        live = model.joints[model.getJointId(name)]
        velocity = _limit(float(np.max(model.velocityLimit[live.idx_v : live.idx_v + live.nv])))
        lower = upper = None
        if live.nq == live.nv == 1:
            lower, upper = _limit(model.lowerPositionLimit[live.idx_q]), _limit(model.upperPositionLimit[live.idx_q])
        joints.append(Joint(name, kind, leader, lower, upper, velocity or None))
    return joints + [Joint(name, "fixed") for name, kind in kinds.items() if kind == "fixed"]


def _limit(value: float) -> float | None:
    return float(value) if abs(value) < ENDLESS else None


def joint_notes(joints: Sequence[Joint], config: RobotConfig) -> list[Note]:
    """Return notes on joints whose limits are missing or cannot be meant."""
    moving = [joint for joint in joints if joint.kind in _MAX_SPEED and not (joint.locked or joint.led)]
    spans = {
        joint.name: (joint, joint.upper - joint.lower)
        for joint in moving
        if joint.kind in _MAX_RANGE and joint.lower is not None and joint.upper is not None
    }
    position, velocity, acceleration = (
        f"`limits: {{{kind}: {{JOINT: {value}}}}}` in a robot.yaml"
        for kind, value in (("position", "[-2.0, 2.0]"), ("velocity", "1.5"), ("acceleration", "10.0"))
    )
    faults: tuple[tuple[Any, NoteKind, str, list[str], str], ...] = (
        ("warning", NoteKind.LIMIT, "no position limits",
         [j.name for j in moving if j.kind in _MAX_RANGE and (j.name not in spans or j.lower == j.upper == 0.0)],
         position),
        ("warning", NoteKind.LIMIT, "no velocity limit", [j.name for j in moving if j.velocity is None], velocity),
        ("warning", NoteKind.LIMIT, "a velocity limit beyond what such joints do",
         [j.name for j in moving if j.velocity is not None and j.velocity > _MAX_SPEED[j.kind]], velocity),
        ("warning", NoteKind.LIMIT, "a range wider than such joints have",
         [name for name, (joint, span) in spans.items() if span > _MAX_RANGE[joint.kind]], position),
        ("warning", NoteKind.JOINT, "hardly any range",
         [name for name, (_, span) in spans.items() if 0.0 < span < _MIN_RANGE],
         "`lock: {JOINT: 0.0}` in a robot.yaml"),
        ("warning", NoteKind.JOINT, "mimic joints that move on their own here", [j.name for j in moving if j.mimics],
         "`qpavoid robot add` holds them and those that they follow; or list them under `lock`"),
        ("note", NoteKind.LIMIT, "no acceleration limit (a URDF has no field for it)",
         [j.name for j in moving if j.name not in config.limits.acceleration], acceleration),
    )  # fmt: skip
    return [
        Note(kind, tuple(names), clause, remedy, severity) for severity, kind, clause, names, remedy in faults if names
    ]
