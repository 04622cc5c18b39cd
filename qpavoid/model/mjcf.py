"""MJCF files, read through Pinocchio with a check that no geom of a body is lost."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

import coal
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.geometry.meshes import check_mesh
from qpavoid.model.urdf_tree import check_counts, numbers_of

_UNREAD = ("frame", "replicate", "composite", "flexcomp", "attach")
"""Elements of a worldbody that Pinocchio passes over, with the bodies, joints and geoms in them."""
_PLAIN = "save it as one plain file, for example with mj_saveLastXML"
_NUMBERS = {
    "pos", "quat", "axis", "axisangle", "xyaxes", "zaxis", "euler", "range", "size", "fromto", "ref", "scale", "mass",
    "diaginertia", "fullinertia", "vertex",
}  # fmt: skip
"""Attributes that are numbers, in every element that has them."""


def check_mjcf(root: ET.Element) -> None:
    """Check an MJCF for what Pinocchio passes over without a word.

    Raises:
        ValueError: naming the element, and a remedy.
    """
    if root.find(".//include") is not None:
        raise ValueError(f"it has an <include>; {_PLAIN}")
    for tag in _UNREAD:
        if root.find(f"worldbody//{tag}") is not None:
            raise ValueError(f"what is in a <{tag}> would be lost; {_PLAIN}")
    bodies, joints, geoms = (len(root.findall(f"worldbody//{tag}")) for tag in ("body", "joint", "geom"))
    check_counts(bodies, joints, geoms)
    if not bodies:
        raise ValueError("its worldbody has no body")
    for element in root.iter():
        for key in sorted(_NUMBERS.intersection(element.keys())):
            numbers_of(element.get(key, ""), f"{element.tag} {key}={element.get(key)!r:.60}")


def read_mjcf(mjcf: Path, root_joint: Any) -> Any:
    """Read the Pinocchio model of an MJCF, with a joint between the world and the root body unless that is None."""
    if root_joint is None:
        return pin.buildModelFromMJCF(str(mjcf))
    return pin.buildModelFromMJCF(str(mjcf), root_joint, "root_joint")[0]


def read_geoms(mjcf: Path, root: ET.Element, model: Any, visual: bool) -> Any:
    """Read the geoms of an MJCF that collide, or the visual ones, into a geometry model.

    A geom collides if its contype or conaffinity is not 0. What the file fixes to its world (a floor) is no part of the
    robot and left out.

    Raises:
        ConfigError: a geom that Pinocchio does not read, or a plane that would move, naming the body.
    """
    geometries = {kind: pin.buildGeomFromMJCF(model, str(mjcf), kind) for kind in (pin.COLLISION, pin.VISUAL)}
    for geometry in geometries.values():
        for name in [piece.name for piece in geometry.geometryObjects if piece.parentFrame == 0]:
            geometry.removeGeometryObject(name)
    pieces = {piece.name: piece for geometry in geometries.values() for piece in geometry.geometryObjects}
    counts = Counter(model.frames[piece.parentFrame].name for piece in pieces.values())
    for body in root.iterfind("worldbody//body"):
        name, count = body.get("name", ""), len(body.findall("geom"))
        if counts[name] < count:
            raise ConfigError(
                f"{mjcf}: not a usable MJCF: body {name!r}: {counts[name]} of its {count} geoms can be read; give "
                f"every body and geom a name of its own, or {_PLAIN}"
            )
    for piece in pieces.values():
        try:
            if isinstance(piece.geometry, coal.Halfspace | coal.Plane):
                raise ValueError("a plane that moves; make it a box")
            if isinstance(piece.geometry, coal.BVHModelBase):
                check_mesh(piece.geometry)
        except ValueError as fault:
            raise ConfigError(f"{mjcf}: not a usable MJCF: geom {piece.name!r}: {fault}") from None
    return geometries[pin.VISUAL if visual else pin.COLLISION]
