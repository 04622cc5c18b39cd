"""Links and joints of a URDF as Pinocchio is given them: faults mended and named, and no shapes."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.trajectory import rpy_to_matrix
from qpavoid.model.urdf_check import floats

_LIMITED = ("revolute", "prismatic")
"""Types of joints that have a range."""
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def tree_xml(root: ET.Element, notes: list[Note]) -> str:
    """Write a URDF without shapes, materials and elements of other tools.

    The parser behind Pinocchio leaves a link at its first fault, whatever comes after it in the link: of an inertial, a
    visual, a collision. Shapes are therefore read apart from it (`read_shapes`).

    Args:
        root: of the file, which `check_urdf` has passed.
        notes: what was mended is added to them.

    Raises:
        ValueError: an origin or an axis of another number of numbers than it needs, naming the joint.
    """
    robot = ET.Element("robot", name=root.get("name") or "robot")
    for link in root.findall("link"):
        _add_link(robot, link, notes)
    for joint in root.findall("joint"):
        _add_joint(robot, joint, notes)
    return ET.tostring(robot, encoding="unicode")


def origin(element: ET.Element, where: str) -> Any:
    """Read the placement (SE3) of an element's <origin>; the identity where it has none.

    Raises:
        ValueError: not three numbers (four of a quaternion), naming the element.
    """
    child = element.find("origin")
    if child is None:
        return pin.SE3.Identity()
    position = vector(child, "xyz", 3, where, (0.0, 0.0, 0.0))
    if child.get("quat_xyzw") is None:
        roll, pitch, yaw = vector(child, "rpy", 3, where, (0.0, 0.0, 0.0))
        return pin.SE3(rpy_to_matrix((roll, pitch, yaw)), np.array(position))
    if child.get("rpy") is not None:
        raise ValueError(f"{where}: origin has both rpy and quat_xyzw; give one")
    quaternion = np.array(vector(child, "quat_xyzw", 4, where, ()))
    if np.linalg.norm(quaternion) < 1e-6:
        raise ValueError(f"{where}: origin quat_xyzw={child.get('quat_xyzw')!r} has no length")
    return pin.SE3(pin.Quaternion(quaternion / np.linalg.norm(quaternion)), np.array(position))


def vector(element: ET.Element, attribute: str, size: int, where: str, default: Sequence[float]) -> list[float]:
    """Read the numbers of an attribute.

    Args:
        element: that has it.
        attribute: its name.
        size: how many numbers there must be.
        where: what to name in errors.
        default: numbers where the attribute is left out; nothing where it must not be.

    Raises:
        ValueError: missing, not numbers, or another number of them.
    """
    text = element.get(attribute)
    place = f"{where}: {element.tag} {attribute}"
    if text is None:
        if default:
            return list(default)
        raise ValueError(f"{place} is missing; give it {size} number{'s' * (size > 1)}")
    numbers = list(floats(text, f"{place}={text!r}"))
    if len(numbers) != size:
        raise ValueError(f"{place}={text!r}: {len(numbers)} numbers; give {size}")
    return numbers


def joints_fixed_by_limits(root: ET.Element, notes: list[Note]) -> dict[str, float]:
    """Find the joints whose lower limit is their upper one, with that value [rad or m].

    Where every range of a file goes from 0 to 0, as some exporters write it unless asked for another one, it says
    nothing, and no joint is fixed; nor is one that mimics another.

    Args:
        root: of the file.
        notes: ranges that say nothing are named in them.
    """
    ranges = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("type") in _LIMITED and limit is not None and joint.find("mimic") is None:
            ranges[joint.get("name", "")] = _range(limit)
    if all(limits in (None, (0.0, 0.0)) for limits in ranges.values()):
        if empty := tuple(name for name, limits in ranges.items() if limits is not None):
            clause = "every range of the file is [0, 0], which says nothing: they move without position limits"
            notes.append(Note(NoteKind.LIMIT, empty, clause, "give their ranges under `limits.position`", "warning"))
        return {}
    return {name: limits[0] for name, limits in ranges.items() if limits is not None and limits[0] == limits[1]}


def _range(limit: ET.Element) -> tuple[float, float] | None:
    """Read the lower and upper limit, 0 where one is left out; None where both are."""
    if limit.get("lower") is None and limit.get("upper") is None:
        return None
    lower, upper = (next(floats(limit.get(side, ""), f"limit {side}"), 0.0) for side in ("lower", "upper"))
    return lower, upper


def _add_link(robot: ET.Element, link: ET.Element, notes: list[Note]) -> None:
    name = link.get("name", "")
    element = ET.SubElement(robot, "link", name=name)
    inertial = link.find("inertial")
    if inertial is None:
        return
    try:
        placement = origin(inertial, f"link {name!r}: inertial")
        mass = vector(_child(inertial, "mass"), "value", 1, "inertial", ())[0]
    except ValueError as fault:
        clause = f"its inertial is left out: {str(fault).removeprefix(f'link {name!r}: ')}"
        notes.append(Note(NoteKind.LINK, (name,), clause, "none is needed unless torques are asked for"))
        return
    inertia = inertial.find("inertia")
    try:
        if inertia is None:
            raise ValueError("inertia is missing")
        moments = [vector(inertia, moment, 1, "inertial", ())[0] for moment in _INERTIA]
    except ValueError as fault:
        clause = f"its mass counts as a point's: {str(fault).removeprefix('inertial: ')}"
        notes.append(Note(NoteKind.LINK, (name,), clause, "none is needed unless torques are asked for"))
        moments = [0.0] * len(_INERTIA)
    inertial_copy = ET.SubElement(element, "inertial")
    _add_origin(inertial_copy, inertial, placement)
    ET.SubElement(inertial_copy, "mass", value=repr(mass))
    ET.SubElement(inertial_copy, "inertia", dict(zip(_INERTIA, map(repr, moments), strict=True)))


def _child(element: ET.Element, tag: str) -> ET.Element:
    child = element.find(tag)
    if child is None:
        raise ValueError(f"{element.tag}: {tag} is missing")
    return child


def _add_joint(robot: ET.Element, joint: ET.Element, notes: list[Note]) -> None:
    name, kind = joint.get("name", ""), joint.get("type", "")
    where = f"joint {name!r}"
    element = ET.SubElement(robot, "joint", name=name, type=kind)
    for tag in ("parent", "child"):
        ET.SubElement(element, tag, link=_child(joint, tag).get("link", ""))
    _add_origin(element, joint, origin(joint, where))
    for axis in joint.findall("axis")[:1]:
        ET.SubElement(element, "axis", xyz=" ".join(map(repr, vector(axis, "xyz", 3, where, (1.0, 0.0, 0.0)))))
    for tag, attributes in (("mimic", ("joint", "multiplier", "offset")), ("dynamics", ("damping", "friction"))):
        for child in joint.findall(tag)[:1]:
            values = {attribute: child.get(attribute) for attribute in attributes}
            ET.SubElement(element, tag, {key: text for key, text in values.items() if text is not None})
    _add_limit(element, joint, notes)


def _add_origin(element: ET.Element, source: ET.Element, placement: Any) -> None:
    """Add the <origin> of a source element to another one, a quaternion as roll, pitch, yaw."""
    child = source.find("origin")
    if child is None:
        return
    rpy = child.get("rpy", "0 0 0")
    if child.get("quat_xyzw") is not None:
        rpy = " ".join(map(repr, pin.rpy.matrixToRpy(placement.rotation).tolist()))
    ET.SubElement(element, "origin", xyz=child.get("xyz", "0 0 0"), rpy=rpy)


def _add_limit(element: ET.Element, joint: ET.Element, notes: list[Note]) -> None:
    """Add the limit of a joint, its range in order.

    Speeds and efforts that are left out become 0.
    """
    name, limit = joint.get("name", ""), joint.find("limit")
    limited = joint.get("type") in _LIMITED
    if limit is None:
        limit = ET.Element("limit")
        if not limited:
            return
    where = f"joint {name!r}"
    values = {
        attribute: vector(limit, attribute, 1, where, (0.0,))[0]
        for attribute in ("lower", "upper", "velocity", "effort")
        if limit.get(attribute) is not None
    }
    fields = {"velocity": 0.0, "effort": 0.0, **values}
    remedy = "give its range under `limits.position`"
    limits = _range(limit)
    if limited and limits is None:
        clause = "has no <limit> lower and upper: it moves without position limits"
        notes.append(Note(NoteKind.LIMIT, (name,), clause, remedy, "warning"))
    elif limited and limits is not None and limits[0] > limits[1]:
        clause = f"its lower limit {limits[0]:g} is above its upper one {limits[1]:g}: the two are swapped"
        notes.append(Note(NoteKind.LIMIT, (name,), clause, remedy, "warning"))
        fields["lower"], fields["upper"] = limits[1], limits[0]
    ET.SubElement(element, "limit", {key: repr(value) for key, value in fields.items() if math.isfinite(value)})
