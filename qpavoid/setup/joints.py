"""Joints of a robot: those that mimic others, turn wheels or are to be locked, and the poses that an SRDF names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.geometry.bodies import bounding_box
from qpavoid.model.joints import middle_configuration
from qpavoid.model.kinematics import MIMIC
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.robot import Robot
from qpavoid.model.urdf import is_mjcf
from qpavoid.model.xml_file import read_robot_xml
from qpavoid.problem import Array
from qpavoid.setup.shapes import Piece
from qpavoid.setup.srdf import Semantics

ENDLESS = 1e9
"""Position or speed from which a limit means that there is none, as files write it [rad or m, rad/s or m/s]."""
_DIGITS = 5
"""Decimals of positions in files [rad or m]."""
_WHEEL = re.compile(r"wheel|caster|castor", re.IGNORECASE)
_GROUND = 0.02
"""Height above the robot's lowest point, as a share of its own, up to which a shape stands on the ground [-]."""


def home_candidates(robot: Robot, semantics: Semantics) -> list[Array]:
    """List candidate home poses, rounded and within the limits: those of the SRDF, then the middle of the ranges."""
    states: list[Mapping[str, float]] = [*semantics.states.values(), {}]
    return [_posed(robot.model, robot.home, state) for state in states]


def _posed(model: Any, q: Array, state: Mapping[str, float]) -> Array:
    values = {**joint_values(model, q), **{name: value for name, value in state.items() if model.existJointName(name)}}
    q = q.copy()
    for name, value in values.items():
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 1:
            low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            q[joint.idx_q] = np.clip(round(value, 4), low, high) if low < high else round(value, 4)
        elif joint.nq == 2:
            q[joint.idx_q : joint.idx_q + 2] = math.cos(round(value, 4)), math.sin(round(value, 4))
    return q


def joint_values(model: Any, q: Array) -> dict[str, float]:
    """Return the position of every joint that one number describes [rad or m]."""
    values = {}
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if joint.nq == 1:
            values[name] = round(float(q[joint.idx_q]), _DIGITS)
        elif joint.nq == 2 and joint.nv == 1:
            values[name] = round(math.atan2(q[joint.idx_q + 1], q[joint.idx_q]), _DIGITS)
    return values


def joint_locks(
    urdf: Path, model: Any, patterns: Sequence[str], semantics: Semantics, notes: list[Note], wheels: Sequence[str]
) -> dict[str, float]:
    """Find the joints to lock, with their positions.

    Those that the user names, wheels, and joints that could not follow another one. A joint that mimics another one
    follows it without a coordinate of its own, and the other one stays free. Where Pinocchio cannot read the two so,
    they would move on their own, which they cannot, and both are locked.
    """
    names = list(model.names)[1:]
    locks: list[str] = []
    for pattern in patterns:
        matches = [name for name in names if fnmatchcase(name, pattern)]
        if not matches:
            raise UnknownName(f"--lock: no joint {pattern!r}{nearest(pattern, names)}")
        locks += matches
    if wheels := [name for name in wheels if name not in locks]:
        clause = "locked: wheels of a mobile base, whose own coordinates move it"
        notes.append(Note(NoteKind.JOINT, tuple(wheels), clause, "take them out of `lock` to drive them"))
        locks += wheels
    followers = {name: source for name, source in mimics(urdf).items() if name in names}
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


def mimics(urdf: Path) -> dict[str, tuple[str, float, float]]:
    """Read the mimic joints: the joint that each follows, multiplier and offset."""
    joints = [] if is_mjcf(urdf) else list(read_robot_xml(urdf, "URDF").iter("joint"))
    return {
        joint.get("name", ""): (tag.get("joint", ""), float(tag.get("multiplier", "1")), float(tag.get("offset", "0")))
        for joint in joints
        for tag in joint.findall("mimic")[:1]
    }


def joint_kind(joint: Any) -> str:
    """Return the kind of a joint in words of a URDF: by its Pinocchio type."""
    name = joint.shortname().removeprefix("JointModel")
    kinds = {"RUB": "continuous", "RevoluteUnbounded": "continuous", "Planar": "planar", "P": "prismatic",
             "Translation": "prismatic", "FreeFlyer": "floating", "Spherical": "spherical"}  # fmt: skip
    return next((kind for start, kind in kinds.items() if name.startswith(start)), "revolute")


def wheel_joints(model: Any, pieces: Sequence[Piece]) -> list[str]:
    """Find the joints of wheels and casters of a mobile base, whose own coordinates stand for them.

    Those that are continuous and bear such a name, they or their link; and those with a horizontal axis whose
    link is a cylinder or ball that stands on the ground.

    Args:
        model: pinocchio model, its root joint planar or floating.
        pieces: geometry of its links.
    """
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = data.J.reshape(6, -1, order="F")[3:]
    lowest, highest, round_ones = np.inf, -np.inf, dict[int, float]()
    for piece in pieces:
        frame = model.frames[model.getFrameId(piece.link, pin.BODY)]
        center, half = bounding_box(piece.geometry)
        pose = data.oMi[frame.parentJoint] * frame.placement * piece.placement
        middle, half_height = float(pose.act(center)[2]), float(np.abs(pose.rotation[2]) @ half)
        lowest, highest = min(lowest, middle - half_height), max(highest, middle + half_height)
        if isinstance(piece.geometry, coal.Cylinder | coal.Sphere):
            round_ones[frame.parentJoint] = min(middle - half_height, round_ones.get(frame.parentJoint, np.inf))
    wheels = []
    for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        if not _turns_for_ever(model, joint):
            continue
        links = [frame.name for frame in model.frames if frame.parentJoint == joint.id and frame.type == pin.BODY]
        is_on_ground = round_ones.get(joint.id, np.inf) <= lowest + _GROUND * (highest - lowest)
        is_level = abs(axes[2, joint.idx_vExtended]) < 0.1
        if any(map(_WHEEL.search, (name, *links))) or (is_on_ground and is_level and not model.children[joint.id]):
            wheels.append(str(name))
    return wheels


def _turns_for_ever(model: Any, joint: Any) -> bool:
    if joint.shortname() == MIMIC or joint_kind(joint) != "revolute":
        return joint_kind(joint) == "continuous"
    return bool(min(-model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]) >= ENDLESS)
