"""What a URDF or MJCF must be before pinocchio reads it: NaN, cycles and axes of no length pass without a word."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

from qpavoid.config.base import LARGEST
from qpavoid.errors import ConfigError, nearest
from qpavoid.model.xml_file import read_robot_xml

_MOST_LINKS, _MOST_MOVING, _MOST_SHAPES = 1000, 200, 300
"""Humanoids have 130, 101 and 112. Parsers recurse along a chain; memory grows with the cube of the joints that move,
and the pairs with the square of the shapes."""

DRAKE = "drake:"
"""What elements of URDF are called by that begin with it: <drake:capsule>, <drake:ellipsoid>."""
_NUMBERS = {
    "origin": ("xyz", "rpy", "quat_xyzw"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "velocity", "effort"),
    "mimic": ("multiplier", "offset"),
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "ellipsoid": ("radii", "a", "b", "c"),
    "mesh": ("scale",),
    "mass": ("value",),
    "inertia": ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
}
"""Element: its attributes that are numbers."""
_SIZES = ("box", "sphere", "cylinder", "capsule", "ellipsoid")
_TURNING = ("revolute", "continuous", "prismatic", "planar")


def check_urdf(path: Path) -> None:
    """Check a URDF before Pinocchio reads it.

    Raises:
        ConfigError: naming file, link or joint, element and remedy.
    """
    root = read_robot_xml(path, "URDF")
    try:
        links, joints = _named(root, "link"), _named(root, "joint")
        moving = [joint for joint in joints.values() if joint.get("type") != "fixed"]
        for count, most, noun in (
            (len(links), _MOST_LINKS, "links"),
            (len(moving), _MOST_MOVING, "joints that move"),
            (len(root.findall("link/collision")), _MOST_SHAPES, "collision shapes"),
        ):
            if count > most:
                raise ValueError(f"{count} {noun}; at most {most} are read")
        _check_tree(links, joints)
        for name, link in links.items():
            for part in (*link.findall("collision"), *link.findall("inertial")):
                check_numbers(part, f"link {name!r}")
        for name, joint in joints.items():
            check_numbers(joint, f"joint {name!r}")
            _check_joint(joint, f"joint {name!r}")
    except ValueError as fault:
        raise ConfigError(f"{path}: not a usable URDF: {fault}") from None


def check_mjcf(path: Path) -> None:
    """Check an MJCF before Pinocchio reads it.

    Raises:
        ConfigError: naming file, element and remedy.
    """
    root = read_robot_xml(path, "MJCF")
    where = f"{path}: not a usable MJCF"
    if root.find(".//include") is not None:
        raise ConfigError(f"{where}: it has an <include>; save it as one file, for example with mj_saveLastXML")
    for tag, most, noun in (
        ("body", _MOST_LINKS, "bodies"), ("joint", _MOST_MOVING, "joints"), ("geom", _MOST_SHAPES, "shapes"),
    ):  # fmt: skip
        count = len(root.findall(f"worldbody//{tag}"))
        if count > most:
            raise ConfigError(f"{where}: {count} {noun}; at most {most} are read")
    if root.find("worldbody//body") is None:
        raise ConfigError(f"{where}: its worldbody has no body")
    for element in root.iter():
        for attribute in sorted(_MJCF_NUMBERS.intersection(element.keys())):
            place = f"{element.tag} {attribute}={element.get(attribute)!r:.60}"
            try:
                finite = all(abs(value) <= LARGEST for value in floats(element.get(attribute, ""), place))
            except ValueError as fault:
                raise ConfigError(f"{where}: {fault}") from None
            if not finite:
                raise ConfigError(f"{where}: {place}: must be finite, and at most {LARGEST:g}")


_MJCF_NUMBERS = {
    "pos", "quat", "axis", "axisangle", "xyaxes", "zaxis", "euler", "range", "size", "fromto", "ref", "scale", "mass",
    "diaginertia", "fullinertia", "vertex",
}  # fmt: skip
"""Attributes that are numbers, in every element that has them."""


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
        parent, child = (_end(joint, tag, name, links) for tag in ("parent", "child"))
        if child in above:
            raise ValueError(f"joint {name!r}: link {child!r} already hangs from {above[child]!r}; give it one parent")
        above[child] = parent
    roots = [name for name in links if name not in above]
    if not links:
        raise ValueError("it has no link")
    if len(roots) > 1:
        raise ValueError(f"links {roots[0]!r} and {roots[1]!r} hang from no joint; join them, a robot is one tree")
    for start in links:
        name, steps = start, 0
        while name in above:
            name, steps = above[name], steps + 1
            if steps > len(links):
                raise ValueError(f"link {start!r} hangs from a cycle of joints; a robot is a tree")


def _end(joint: ET.Element, tag: str, name: str, links: dict[str, ET.Element]) -> str:
    element = joint.find(tag)
    link = None if element is None else element.get("link")
    if link is None:
        raise ValueError(f"joint {name!r}: <{tag} link=…> is missing")
    if link not in links:
        raise ValueError(f"joint {name!r}: {tag}: no link {link!r}{nearest(link, links)}")
    return link


def check_numbers(part: ET.Element, owner: str) -> None:
    """Check that the numbers of an element and of those in it are finite.

    None of a size may be negative.

    Raises:
        ValueError: naming the owner, the element and the attribute.
    """
    for element in part.iter():
        tag = element.tag.removeprefix(DRAKE)
        for attribute in _NUMBERS.get(tag, ()):
            where = f"{owner}: {tag} {attribute}={element.get(attribute)!r}"
            for value in floats(element.get(attribute, ""), where):
                if not math.isfinite(value):
                    raise ValueError(f"{where}: must be finite")
                if abs(value) > LARGEST and tag != "limit":  # where it means that there is none
                    raise ValueError(f"{where}: must be at most {LARGEST:g}")
                if tag in _SIZES and value < 0.0:
                    raise ValueError(f"{where}: must not be negative")
                if tag == "mesh" and value == 0.0:
                    raise ValueError(f"{where}: must not be 0")


def floats(text: str, where: str) -> Iterator[float]:
    """Yield the numbers of an attribute.

    Raises:
        ValueError: one that is no number.
    """
    for word in text.split():
        try:
            yield float(word)
        except ValueError:
            raise ValueError(f"{where}: {word!r} is not a number") from None


def _check_joint(joint: ET.Element, where: str) -> None:
    for axis in joint.findall("axis") if joint.get("type") in _TURNING else ():
        if math.hypot(*floats(axis.get("xyz", ""), where)) < 1e-6:
            raise ValueError(f"{where}: axis xyz={axis.get('xyz')!r} has no length; give a direction such as 0 0 1")
    for limit in joint.findall("limit"):
        velocity = next(floats(limit.get("velocity", ""), where), 0.0)
        if velocity < 0.0:
            raise ValueError(f"{where}: limit velocity={velocity:g}: must not be negative")
