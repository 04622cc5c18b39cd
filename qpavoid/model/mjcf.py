"""MJCF files, read through Pinocchio with a check that no geom of a body is lost."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coal
import pinocchio as pin

from qpavoid.errors import ConfigError

_UNREAD = ("frame", "replicate", "composite", "flexcomp", "attach")
"""Elements of a worldbody that Pinocchio passes over, with the bodies, joints and geoms in them."""
_ANEW = "save it as one plain file, for example with mj_saveLastXML"


def model_of_mjcf(mjcf: Path, root: Any) -> Any:
    """Read the Pinocchio model of an MJCF.

    Args:
        mjcf: the file.
        root: joint between the world and the root body, or None.
    """
    with warnings.catch_warnings():  # of a change of name that older versions do not have
        warnings.simplefilter("ignore", DeprecationWarning)
        if root is None:
            return pin.buildModelFromMJCF(str(mjcf))
        return pin.buildModelFromMJCF(str(mjcf), root, "root_joint")[0]


def shapes_of_mjcf(mjcf: Path, root: ET.Element, model: Any, visual: bool) -> Any:
    """Read the geoms that collide, or the visual ones, into a geometry model.

    A geom collides if its contype or conaffinity is not 0.

    What the file fixes to its world (a floor) is no part of the robot and left out.

    Args:
        mjcf: the file.
        root: its XML.
        model: its Pinocchio model.
        visual: what is meant to be seen instead.

    Raises:
        ConfigError: a geom that Pinocchio does not read, or a plane that would move, naming the body.
    """
    geometries = {kind: pin.buildGeomFromMJCF(model, str(mjcf), kind) for kind in (pin.COLLISION, pin.VISUAL)}
    _check_every_geom(mjcf, root, model, geometries.values())
    geometry = geometries[pin.VISUAL if visual else pin.COLLISION]
    for name in [piece.name for piece in geometry.geometryObjects if piece.parentFrame == 0]:
        geometry.removeGeometryObject(name)
    return geometry


def check_elements(mjcf: Path, root: ET.Element) -> None:
    """Check that an MJCF has no element that Pinocchio passes over.

    Raises:
        ConfigError: naming it.
    """
    for tag in _UNREAD:
        if root.find(f"worldbody//{tag}") is not None:
            raise ConfigError(f"{mjcf}: not a usable MJCF: what is in a <{tag}> would be lost; {_ANEW}")


def _check_every_geom(mjcf: Path, root: ET.Element, model: Any, geometries: Any) -> None:
    pieces = {
        piece.name: piece for geometry in geometries for piece in geometry.geometryObjects if piece.parentFrame != 0
    }
    counts = Counter(model.frames[piece.parentFrame].name for piece in pieces.values())
    for body, count in _geoms(root):
        if counts[body] < count:
            raise ConfigError(
                f"{mjcf}: not a usable MJCF: body {body!r}: {counts[body]} of its {count} geoms can be read; give "
                f"every body and geom a name of its own, or {_ANEW}"
            )
    for piece in pieces.values():
        if isinstance(piece.geometry, coal.Halfspace | coal.Plane):
            raise ConfigError(f"{mjcf}: not a usable MJCF: geom {piece.name!r}: a plane that moves; make it a box")


def _geoms(root: ET.Element) -> Iterator[tuple[str, int]]:
    """Yield the name of every body and the number of its geoms."""
    for body in root.iterfind("worldbody//body"):
        yield body.get("name", ""), len(body.findall("geom"))
