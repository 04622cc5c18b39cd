"""Poses of a robot's joints: those that an SRDF names, and those at which joints are locked."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.model.joints import middle_configuration
from qpavoid.model.kinematics import MIMIC
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.robot import Robot
from qpavoid.model.urdf import is_mjcf
from qpavoid.model.xml_file import read_robot_xml
from qpavoid.problem import Array
from qpavoid.setup.srdf import Semantics

_DIGITS = 5
"""Decimals of positions in files [rad or m]."""


def home_candidates(robot: Robot, semantics: Semantics) -> list[Array]:
    """List candidate home poses: those of the SRDF, then the middle of the ranges.

    They are rounded, and within the limits.
    """
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
    urdf: Path,
    model: Any,
    patterns: Sequence[str],
    semantics: Semantics,
    notes: list[Note],
    wheels: Sequence[str] = (),
) -> dict[str, float]:
    """Find the joints to lock, with their positions.

    Those that the user names, wheels, and joints that could not follow another one.

    A joint that mimics another one follows it without a coordinate of its own, and the other one stays free. Where
    Pinocchio cannot read the two so, they would move on their own, which they cannot, and both are locked.
    """
    names = list(model.names)[1:]
    lock_names = []
    for pattern in patterns:
        result = [name for name in names if fnmatchcase(name, pattern)]
        if not result:
            raise UnknownName(f"--lock: no joint {pattern!r}{nearest(pattern, names)}")
        lock_names += result
    if wheels := [name for name in wheels if name not in lock_names]:
        clause = "locked: wheels of a mobile base, whose own coordinates move it"
        notes.append(Note(NoteKind.JOINT, tuple(wheels), clause, "take them out of `lock` to drive them"))
    lock_names += wheels
    followers = {name: source for name, source in mimics(urdf).items() if name in names}
    uncoupled = {name for name in followers if model.joints[model.getJointId(name)].shortname() != MIMIC}
    coupled = [name for name in names if name in uncoupled or name in {followers[other][0] for other in uncoupled}]
    if coupled := [name for name in coupled if name not in lock_names]:
        clause = "locked: they move together (mimic), in a way that the model cannot hold"
        notes.append(Note(NoteKind.JOINT, tuple(coupled), clause, severity="warning"))
    leaders = dict.fromkeys(source for name, (source, _, _) in followers.items() if name not in uncoupled)
    if drivers := [name for name in leaders if name not in (*lock_names, *coupled)]:
        clause = "free, and moved for avoidance: others follow them (mimic), as fingers do"
        notes.append(Note(NoteKind.JOINT, tuple(drivers), clause, f"--lock {drivers[0]} where something else moves it"))
    state = next(iter(semantics.states.values()), {})
    start = joint_values(model, _posed(model, middle_configuration(model), state))
    values = {}
    for name in [*lock_names, *coupled]:
        if model.joints[model.getJointId(name)].shortname() == MIMIC:
            continue  # it is locked with the one that it follows
        if name not in start:
            raise ConfigError(f"--lock: joint {name!r} is not described by one number and cannot be held; leave it out")
        leader, multiplier, offset = followers.get(name, (name, 1.0, 0.0))
        values[name] = round(multiplier * start.get(leader, 0.0) + offset, _DIGITS)
    return values


def mimics(urdf: Path) -> dict[str, tuple[str, float, float]]:
    """Read the mimic joints: the joint that each follows, multiplier and offset."""
    if is_mjcf(urdf):
        return {}
    result: dict[str, tuple[str, float, float]] = {}
    for joint in read_robot_xml(urdf, "URDF").iter("joint"):
        mimic: ET.Element | None = joint.find("mimic")
        if mimic is not None:
            numbers = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            result[joint.get("name", "")] = (mimic.get("joint", ""), *numbers)
    return result
