"""Visual shapes of a robot's file: where they are on its joints, and their colours."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import coal
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.model.packages import mesh_folders
from qpavoid.model.urdf import is_mjcf, read_model
from qpavoid.model.urdf_shapes import ShapeReader
from qpavoid.model.xml_file import read_robot_xml

GREY = (0.72, 0.72, 0.74, 1.0)
"""Colour of what has none."""


class Visual(NamedTuple):
    """A shape that is meant to be seen."""

    name: str
    joint: int
    """Joint of the robot's model that moves it."""
    placement: Any
    """Its placement on that joint (SE3)."""
    geometry: Any
    """coal geometry of a primitive."""
    path: str
    """File of its mesh; empty of a primitive."""
    scale: tuple[float, ...]
    """Factors of the mesh's coordinates [-]."""
    colour: tuple[float, ...] | None
    """Red, green, blue, opacity, 0 to 1; None where the file gives none."""


def read_visuals(model: Any, urdf: Path, package_dirs: Sequence[str]) -> list[Visual]:
    """Read the visual shapes of a URDF; those that cannot be read are left out, an MJCF gives none.

    Args:
        model: Pinocchio model that they are placed on, which may have joints of the file locked.
        urdf: the file.
        package_dirs: see `mesh_folders`.
    """
    if is_mjcf(urdf) or not urdf.is_file():
        return []
    try:
        root, whole = read_robot_xml(urdf, "URDF"), read_model(urdf, "fixed")
        reader = ShapeReader(whole, mesh_folders(urdf, package_dirs), str(urdf), [], True, True, _placeholder)
        shapes = reader.read(root, "visual").geometryObjects
    except ConfigError:
        return []
    colours, visuals = _colours(root), []
    for shape in shapes:
        link = whole.frames[shape.parentFrame]
        frame = model.frames[model.getFrameId(link.name, pin.BODY)]
        placement = frame.placement * link.placement.actInv(shape.placement)
        scale = tuple(map(float, shape.meshScale))
        path = shape.meshPath if Path(shape.meshPath).is_file() else ""
        colour = colours.get(shape.name)
        visuals.append(Visual(shape.name, frame.parentJoint, placement, shape.geometry, path, scale, colour))
    return visuals


def _placeholder(path: str, scale: Any) -> Any:
    """Return what stands for a mesh, which is drawn from its file with its colours."""
    return coal.Sphere(1e-3)


def _colours(root: ET.Element) -> dict[str, tuple[float, ...]]:
    """Return the colour of each visual shape that has one, by the name that `ShapeReader` gives it."""
    named = {material.get("name"): material.find("color") for material in root.iterfind(".//material[color]")}
    colours: dict[str, tuple[float, ...]] = {}
    for link in root.iterfind("link"):
        for index, visual in enumerate(link.iterfind("visual")):
            material = visual.find("material")
            if material is None:
                continue
            colour = material.find("color")
            if colour is None:
                colour = named.get(material.get("name"))
            rgba = () if colour is None else _numbers(colour.get("rgba", ""))
            if len(rgba) == 4:
                colours[f"{link.get('name')}_{index}"] = rgba
    return colours


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(number) for number in text.split())
    except ValueError:
        return ()
