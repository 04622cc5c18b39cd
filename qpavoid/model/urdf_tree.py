"""Links and joints of a URDF: checked, and written as Pinocchio is given them, with faults mended and named."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.config.base import LARGEST
from qpavoid.errors import nearest
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.trajectory import rpy_to_matrix

_MOST = {"links": 1000, "joints that move": 200, "collision shapes": 300}
"""Humanoids have 130, 101 and 112. Parsers recurse along a chain; memory grows with the cube of the joints that move,
and the pairs with the square of the shapes."""
_LIMITED = ("revolute", "prismatic")
"""Types of joints that have a range."""
_WITH_AXIS = (*_LIMITED, "continuous", "planar")
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def tree_xml(root: ET.Element, notes: list[Note]) -> str:
    """Write a URDF without shapes, materials and elements of other tools; what was mended is added to the notes.

    The parser behind Pinocchio leaves a link at its first fault, whatever comes after it in the link: of an inertial, a
    visual, a collision. Shapes are therefore read apart from it (`ShapeReader`).

    Raises:
        ValueError: no tree of links, or an origin, axis or limit that is none, naming link or joint, element and
            remedy.
    """
    links, joints = _named(root, "link"), _named(root, "joint")
    moving = [joint for joint in joints.values() if joint.get("type") != "fixed"]
    check_counts(len(links), len(moving), len(root.findall("link/collision")))
    _check_tree(links, joints)
    robot = ET.Element("robot", name=root.get("name") or "robot")
    for link in links.values():
        _add_link(robot, link, notes)
    for joint in joints.values():
        _add_joint(robot, joint, notes)
    return ET.tostring(robot, encoding="unicode")


def check_counts(links: int, moving: int, shapes: int) -> None:
    """Raise ValueError where a file has more links, joints that move or collision shapes than can be worked with."""
    counts = {"links": links, "joints that move": moving, "collision shapes": shapes}
    for noun, count in counts.items():
        if count > _MOST[noun]:
            raise ValueError(f"{count} {noun}; at most {_MOST[noun]} are read")


def origin(element: ET.Element, where: str) -> Any:
    """Read the placement (SE3) of an element's <origin>; the identity where it has none.

    Raises:
        ValueError: not three numbers (four of a quaternion), naming the element.
    """
    child = element.find("origin")
    if child is None:
        return pin.SE3.Identity()
    position = np.array(vector(child, "xyz", 3, where, (0.0, 0.0, 0.0)))
    if child.get("quat_xyzw") is None:
        return pin.SE3(rpy_to_matrix(vector(child, "rpy", 3, where, (0.0, 0.0, 0.0))), position)
    if child.get("rpy") is not None:
        raise ValueError(f"{where}: origin has both rpy and quat_xyzw; give one")
    quaternion = np.array(vector(child, "quat_xyzw", 4, where))
    if np.linalg.norm(quaternion) < 1e-6:
        raise ValueError(f"{where}: origin quat_xyzw={child.get('quat_xyzw')!r} has no length")
    return pin.SE3(pin.Quaternion(quaternion / np.linalg.norm(quaternion)), position)


def vector(
    element: ET.Element,
    attribute: str,
    size: int,
    where: str,
    default: Sequence[float] | None = None,
    largest: float = LARGEST,
) -> list[float]:
    """Read the numbers of an attribute: `size` of them, none above `largest`; the default where it is left out.

    Raises:
        ValueError: missing without a default, not finite numbers, too large, or another number of them.
    """
    text = element.get(attribute)
    if text is None:
        if default is not None:
            return list(default)
        raise ValueError(f"{where}: {element.tag} {attribute} is missing; give it {size} number{'s' * (size > 1)}")
    place = f"{where}: {element.tag} {attribute}={text!r}"
    numbers = numbers_of(text, place, largest)
    if len(numbers) != size:
        raise ValueError(f"{place}: {len(numbers)} numbers; give {size}")
    return numbers


def numbers_of(text: str, where: str, largest: float = LARGEST) -> list[float]:
    """Read the numbers of a text; ValueError where one is no finite number, or too large."""
    numbers = []
    for word in text.split():
        try:
            numbers.append(float(word))
        except ValueError:
            raise ValueError(f"{where}: {word!r} is not a number") from None
        if not math.isfinite(numbers[-1]):
            raise ValueError(f"{where}: must be finite")
        if abs(numbers[-1]) > largest:
            raise ValueError(f"{where}: must be at most {largest:g}")
    return numbers


def joints_fixed_by_limits(root: ET.Element, notes: list[Note]) -> dict[str, float]:
    """Find the joints whose lower limit is their upper one, with that value [rad or m].

    Where every range of a file goes from 0 to 0, as some exporters write it unless asked for another one, it says
    nothing, which is noted, and no joint is fixed; nor is one that mimics another.
    """
    ranges = {
        joint.get("name", ""): _range(_limit_values(limit, ""))
        for joint in root.findall("joint")
        for limit in joint.findall("limit")[:1]
        if joint.get("type") in _LIMITED and joint.find("mimic") is None
    }
    if all(limits in (None, (0.0, 0.0)) for limits in ranges.values()):
        if empty := tuple(name for name, limits in ranges.items() if limits is not None):
            clause = "every range of the file is [0, 0], which says nothing: they move without position limits"
            notes.append(Note(NoteKind.LIMIT, empty, clause, "give their ranges under `limits.position`", "warning"))
        return {}
    return {name: limits[0] for name, limits in ranges.items() if limits is not None and limits[0] == limits[1]}


def _named(root: ET.Element, tag: str) -> dict[str, ET.Element]:
    result: dict[str, ET.Element] = {}
    for element in root.findall(tag):
        name = element.get("name")
        if not name:
            raise ValueError(f"a {tag} has no name; give it one")
        if name in result:
            raise ValueError(f"{tag} {name!r} is given twice; names must differ")
        result[name] = element
    return result


def _check_tree(links: dict[str, ET.Element], joints: dict[str, ET.Element]) -> None:
    """Check that every link but one has one joint above it, and that all form one tree."""
    above: dict[str, str] = {}
    for name, joint in joints.items():
        ends = []
        for tag in ("parent", "child"):
            link = next((element.get("link") for element in joint.findall(tag)), None)
            if link is None:
                raise ValueError(f"joint {name!r}: <{tag} link=…> is missing")
            if link not in links:
                raise ValueError(f"joint {name!r}: {tag}: no link {link!r}{nearest(link, links)}")
            ends.append(link)
        parent, child = ends
        if child in above:
            raise ValueError(f"joint {name!r}: link {child!r} already hangs from {above[child]!r}; give it one parent")
        above[child] = parent
    roots = [name for name in links if name not in above]
    if not links:
        raise ValueError("it has no link")
    if len(roots) > 1:
        raise ValueError(f"links {roots[0]!r} and {roots[1]!r} hang from no joint; join them, a robot is one tree")
    reached = set(roots)
    while below := {child for child, parent in above.items() if parent in reached and child not in reached}:
        reached |= below
    if lost := [name for name in links if name not in reached]:
        raise ValueError(f"link {lost[0]!r} hangs from a cycle of joints; a robot is a tree")


def _add_link(robot: ET.Element, link: ET.Element, notes: list[Note]) -> None:
    """Add a link with its inertial; what is missing of that, or cannot be read, is left out and named."""
    name, inertial = link.get("name", ""), link.find("inertial")
    element = ET.SubElement(robot, "link", name=name)
    if inertial is None:
        return
    mass, inertia, moments = inertial.find("mass"), inertial.find("inertia"), [0.0] * len(_INERTIA)
    clause, severity = "its inertial is left out", "note"
    try:
        if mass is not None:
            part = ET.Element("inertial")
            _add_origin(part, inertial, origin(inertial, "inertial"))
            ET.SubElement(part, "mass", value=repr(vector(mass, "value", 1, "inertial")[0]))
            element.append(part)
            clause = "its mass counts as a point's"
            if inertia is not None and set(_INERTIA) <= set(inertia.keys()):
                moments = [vector(inertia, moment, 1, "inertial")[0] for moment in _INERTIA]
                clause = ""
    except ValueError as fault:
        clause, severity = f"{clause}: {str(fault).removeprefix('inertial: ')}", "warning"
    if clause:
        remedy = "none is needed unless torques are asked for"
        notes.append(Note(NoteKind.LINK, (name,), clause, remedy, severity))  # type: ignore[arg-type]
    for part in element:
        ET.SubElement(part, "inertia", dict(zip(_INERTIA, map(repr, moments), strict=True)))


def _add_joint(robot: ET.Element, joint: ET.Element, notes: list[Note]) -> None:
    name, kind = joint.get("name", ""), joint.get("type", "")
    where = f"joint {name!r}"
    element = ET.SubElement(robot, "joint", name=name, type=kind)
    for tag in ("parent", "child"):
        ET.SubElement(element, tag, link=joint.find(tag).get("link"))  # type: ignore[union-attr, arg-type]
    _add_origin(element, joint, origin(joint, where))
    for axis in joint.findall("axis")[:1] if kind in _WITH_AXIS else ():
        direction = vector(axis, "xyz", 3, where)
        if math.hypot(*direction) < 1e-6:
            raise ValueError(f"{where}: axis xyz={axis.get('xyz')!r} has no length; give a direction such as 0 0 1")
        ET.SubElement(element, "axis", xyz=" ".join(map(repr, direction)))
    for tag, attributes in (("mimic", ("multiplier", "offset")), ("dynamics", ("damping", "friction"))):
        for child in joint.findall(tag)[:1]:
            names = {"joint": child.get("joint", "")} if child.get("joint") is not None else {}
            values = {key: repr(vector(child, key, 1, where)[0]) for key in attributes if child.get(key) is not None}
            ET.SubElement(element, tag, names | values)
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
    """Add the limit of a joint, its range in order; speeds and efforts that are left out become 0."""
    name, limit, limited = joint.get("name", ""), joint.find("limit"), joint.get("type") in _LIMITED
    if limit is None and not limited:
        return
    values = {} if limit is None else _limit_values(limit, f"joint {name!r}")
    if values.get("velocity", 0.0) < 0.0:
        raise ValueError(f"joint {name!r}: limit velocity={values['velocity']:g}: must not be negative")
    limits, clause = _range(values), ""
    if limited and limits is None:
        clause = "has no <limit> lower and upper: it moves without position limits"
    elif limited and limits is not None and limits[0] > limits[1]:
        clause = f"its lower limit {limits[0]:g} is above its upper one {limits[1]:g}: the two are swapped"
        values["upper"], values["lower"] = limits
    if clause:
        notes.append(Note(NoteKind.LIMIT, (name,), clause, "give its range under `limits.position`", "warning"))
    fields = {"velocity": 0.0, "effort": 0.0, **values}
    ET.SubElement(element, "limit", {key: repr(value) for key, value in fields.items()})


def _limit_values(limit: ET.Element, where: str) -> dict[str, float]:
    """Read the numbers that a <limit> has; of any size, where a huge one means that there is none."""
    return {
        key: vector(limit, key, 1, where, largest=math.inf)[0]
        for key in ("lower", "upper", "velocity", "effort")
        if limit.get(key) is not None
    }


def _range(values: dict[str, float]) -> tuple[float, float] | None:
    """Return the lower and upper limit, 0 where one is left out; None where both are."""
    if values.keys().isdisjoint(("lower", "upper")):
        return None
    return values.get("lower", 0.0), values.get("upper", 0.0)
