"""Joints of a robot: what `check` reports of them, which ones `add` locks, and the poses that an SRDF names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config import RobotConfig
from qpavoid.errors import ConfigError, matching
from qpavoid.model.joints import middle_configuration, set_joints
from qpavoid.model.kinematics import MIMIC
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.robot import Robot
from qpavoid.model.urdf import is_mjcf
from qpavoid.model.xml_file import read_robot_xml
from qpavoid.problem import Array
from qpavoid.setup.srdf import Semantics

_ENDLESS = 1e9
"""Position or speed from which a limit means that there is none, as files write it [rad or m, rad/s or m/s]."""
_DIGITS = 5
"""Decimals of positions in files [rad or m]."""
_WHEEL = re.compile(r"wheel|caster|castor", re.IGNORECASE)
_PLAUSIBLE = {"revolute": (1e-3, 8.0 * math.pi, 50.0), "prismatic": (1e-3, 20.0, 10.0), "continuous": (0.0, 0.0, 50.0)}
"""Kind of joint: its smallest and largest range, and its largest speed; beyond them there is probably an error [rad or
m, and per second]."""


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

    `model` is that of the robot as it loads, `whole` that of the file.
    """
    leaders = {name: leader for name, (leader, _, _) in _mimics(urdf).items()}
    elements = [] if is_mjcf(urdf) else read_robot_xml(urdf, "URDF").findall("joint")
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in elements}
    joints = []
    for name, joint in _joints(whole):
        is_follower, leader = joint.shortname() == MIMIC, leaders.get(name)
        kind = kinds[name] if is_follower else _joint_kind(joint)
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


def joint_notes(joints: Sequence[Joint], config: RobotConfig) -> list[Note]:
    """Return notes on joints whose limits are missing or cannot be meant."""
    fast, wide, narrow, free = list[str](), list[str](), list[str](), list[str]()
    for joint in joints:
        if joint.kind not in _PLAUSIBLE or joint.locked or joint.led:
            continue
        least, most, speed = _PLAUSIBLE[joint.kind]
        if joint.velocity is not None and joint.velocity > speed:
            fast.append(joint.name)
        if joint.lower is not None and joint.upper is not None:
            span = joint.upper - joint.lower
            if not 0.0 <= span <= most:
                wide.append(joint.name)
            elif 0.0 < span < least:
                narrow.append(joint.name)
        if not any(fnmatchcase(joint.name, pattern) for pattern in config.limits.acceleration):
            free.append(joint.name)
    position, velocity, acceleration = (
        f"`limits: {{{kind}: {{JOINT: {value}}}}}` in a robot.yaml"
        for kind, value in (("position", "[-2.0, 2.0]"), ("velocity", "1.5"), ("acceleration", "10.0"))
    )
    lock, no_acceleration = "`lock: {JOINT: 0.0}` in a robot.yaml", "no acceleration limit (a URDF has no field for it)"
    notes = [
        Note(NoteKind.LIMIT, tuple(fast), "a velocity limit beyond what such joints do", velocity, "warning"),
        Note(NoteKind.LIMIT, tuple(wide), "a range wider than such joints have", position, "warning"),
        Note(NoteKind.JOINT, tuple(narrow), "hardly any range", lock, "warning"),
        Note(NoteKind.LIMIT, tuple(free), no_acceleration, acceleration),
    ]
    return [note for note in notes if note.subject]


def _joints(model: Any) -> list[tuple[str, Any]]:
    """List names and joints of a model, without the world."""
    return list(zip(list(model.names)[1:], list(model.joints)[1:], strict=True))


def _limit(value: float) -> float | None:
    return float(value) if abs(value) < _ENDLESS else None


def home_candidates(robot: Robot, semantics: Semantics) -> list[Array]:
    """List candidate home poses, rounded and within the limits: those of the SRDF, then the middle of the ranges."""
    states: list[Mapping[str, float]] = [*semantics.states.values(), {}]
    return [_posed(robot.model, robot.home, state) for state in states]


def _posed(model: Any, q: Array, state: Mapping[str, float]) -> Array:
    """Return q (nq,) with other positions of some joints, rounded and within the limits."""
    q = set_joints(model, q, {name: round(state.get(name, x), 4) for name, x in joint_values(model, q).items()}, "home")
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    return np.where(lower < upper, np.clip(q, lower, upper), q)


def joint_values(model: Any, q: Array) -> dict[str, float]:
    """Return the position of every joint that one number describes [rad or m]."""
    values = {}
    for name, joint in _joints(model):
        if joint.nq == 1:
            values[name] = round(float(q[joint.idx_q]), _DIGITS)
        elif joint.nq == 2 and joint.nv == 1:
            values[name] = round(math.atan2(q[joint.idx_q + 1], q[joint.idx_q]), _DIGITS)
    return values


def joint_locks(
    urdf: Path, model: Any, patterns: Sequence[str], semantics: Semantics, notes: list[Note], has_base: bool
) -> dict[str, float]:
    """Find the joints to lock, with their positions.

    Those that the user names, wheels of a mobile base, and joints that could not follow another one. A joint that
    mimics another one follows it without a coordinate of its own, and the other one stays free. Where Pinocchio cannot
    read the two so, they would move on their own, which they cannot, and both are locked.
    """
    names = list(model.names)[1:]
    locks = matching(patterns, names, "--lock: no joint")
    if wheels := [name for name in (_wheels(model) if has_base else ()) if name not in locks]:
        clause = "locked: wheels of a mobile base, whose own coordinates move it"
        notes.append(Note(NoteKind.JOINT, tuple(wheels), clause, "take them out of `lock` to drive them"))
        locks += wheels
    followers = {name: source for name, source in _mimics(urdf).items() if name in names}
    uncoupled = {name for name in followers if model.joints[model.getJointId(name)].shortname() != MIMIC}
    coupled = {*uncoupled, *(followers[name][0] for name in uncoupled)}
    if together := [name for name in names if name in coupled and name not in locks]:
        clause = "locked: they move together (mimic), in a way that the model cannot hold"
        notes.append(Note(NoteKind.JOINT, tuple(together), clause, severity="warning"))
        locks += together
    leaders = dict.fromkeys(source for name, (source, _, _) in followers.items() if name not in uncoupled)
    if drivers := [name for name in leaders if name not in locks]:
        clause = "free, and moved for avoidance: others follow them (mimic), as fingers do"
        notes.append(Note(NoteKind.JOINT, tuple(drivers), clause, f"--lock {drivers[0]} where something else moves it"))
    state = next(iter(semantics.states.values()), {})
    start = joint_values(model, _posed(model, middle_configuration(model), state))
    values = {}
    for name in locks:
        if model.joints[model.getJointId(name)].shortname() == MIMIC:
            continue  # it is locked with the one that it follows
        if name not in start:
            raise ConfigError(f"--lock: joint {name!r} is not described by one number and cannot be held; leave it out")
        leader, multiplier, offset = followers.get(name, (name, 1.0, 0.0))
        values[name] = round(multiplier * start.get(leader, 0.0) + offset, _DIGITS)
    return values


def _mimics(urdf: Path) -> dict[str, tuple[str, float, float]]:
    """Read the mimic joints: the joint that each follows, multiplier and offset."""
    joints = [] if is_mjcf(urdf) else list(read_robot_xml(urdf, "URDF").iter("joint"))
    return {
        joint.get("name", ""): (tag.get("joint", ""), float(tag.get("multiplier", "1")), float(tag.get("offset", "0")))
        for joint in joints
        for tag in joint.findall("mimic")[:1]
    }


def _joint_kind(joint: Any) -> str:
    """Return the kind of a joint in words of a URDF: by its Pinocchio type."""
    name = joint.shortname().removeprefix("JointModel")
    kinds = {"RUB": "continuous", "RevoluteUnbounded": "continuous", "Planar": "planar", "P": "prismatic",
             "Translation": "prismatic", "FreeFlyer": "floating", "Spherical": "spherical"}  # fmt: skip
    return next((kind for start, kind in kinds.items() if name.startswith(start)), "revolute")


def _wheels(model: Any) -> list[str]:
    """Find the joints without an end that are called wheels or casters, they or their links."""
    wheels = []
    for name, joint in _joints(model):
        links = [frame.name for frame in model.frames if frame.parentJoint == joint.id and frame.type == pin.BODY]
        if any(map(_WHEEL.search, (name, *links))) and _turns_for_ever(model, joint):
            wheels.append(str(name))
    return wheels


def _turns_for_ever(model: Any, joint: Any) -> bool:
    if joint.shortname() == MIMIC or _joint_kind(joint) != "revolute":
        return _joint_kind(joint) == "continuous"
    return bool(min(-model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]) >= _ENDLESS)
