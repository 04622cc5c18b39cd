"""Shapes of a URDF: every one of them becomes a coal geometry, is named where it is left out, or refused by name."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.geometry.meshes import load_mesh
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.packages import find_mesh
from qpavoid.model.urdf_tree import origin, vector

THINNEST = 1e-4
"""Size that stands for one of 0, where others are not 0 [m]."""
_PACKAGES = (
    "name the folder that holds the package, or NAME=FOLDER, in `package_dirs` of a robot.yaml, or set ROS_PACKAGE_PATH"
)
MISSING = f"{_PACKAGES}; `allow_missing_meshes` goes on without"
"""Remedy of a mesh that cannot be found."""
_DRAKE = "drake:"
"""Prefix of the shapes that URDF does not have: <drake:capsule>, <drake:ellipsoid>."""
_UNSCALED = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class ShapeReader:
    """Reads the shapes of a URDF into geometry models."""

    model: Any
    """Pinocchio model of the URDF."""
    folders: Sequence[str]
    """Where meshes are looked for; see `mesh_folders`."""
    where: str
    """File to name in errors."""
    notes: list[Note]
    """What is left out or mended is added to them."""
    allow_missing: bool = False
    """Whether a shape whose mesh is missing is left out, with a warning, and not refused."""
    allow_faults: bool = False
    """Whether a shape that cannot be read for whatever reason is left out, with a warning, and not refused."""
    load: Callable[[str, Any], Any] = load_mesh
    """Loads a mesh, given its file and scale, into a coal geometry."""

    def read(self, root: ET.Element, tag: str, skipped: Collection[int] = ()) -> Any:
        """Read the `collision` or `visual` shapes into a geometry model, but for links whose frames are to be skipped.

        A shape is called by its link and its index in it, as in `hand_0`; where one element has several, further ones
        have a second index.

        Raises:
            ConfigError: a shape that cannot be read, or whose mesh is missing, naming link and element.
        """
        geometry = pin.GeometryModel()
        frames = {self.model.getFrameId(link.get("name", ""), pin.BODY): link for link in root.findall("link")}
        for frame_id in sorted(frames.keys() - set(skipped)):  # in the order that Pinocchio has them in
            link, frame = frames[frame_id], self.model.frames[frame_id]
            self._name_strays(link, tag)
            for index, part in enumerate(link.findall(tag)):
                where = f"link {frame.name!r}: {tag} {index}"
                try:
                    for name, placement, *shape in self._shapes(link, part, f"{frame.name}_{index}", where):
                        geometry.addGeometryObject(
                            pin.GeometryObject(name, frame.parentJoint, frame_id, frame.placement * placement, *shape)
                        )
                except ValueError as fault:
                    if not self.allow_faults:
                        raise ConfigError(f"{self.where}: {fault}") from None
                    self._leave_out(f"{frame.name}_{index}", str(fault).removeprefix(f"{where}: "))
        return geometry

    def _shapes(self, link: ET.Element, part: ET.Element, name: str, where: str) -> list[tuple[Any, ...]]:
        """Make the shapes of a <collision> or <visual>: name, placement, geometry, path of the mesh and its scale."""
        placement, result = origin(part, where), []
        elements = part.findall("geometry/*")
        if not elements and part.tag == "collision":
            self._leave_out(name, f"its <{part.tag}> has no shape", "give it one, or take the element out")
        for i, element in enumerate(elements):
            shape_name = name if i == 0 else f"{name}_{i}"
            kind = element.tag.removeprefix(_DRAKE)
            if kind == "cylinder" and part.tag == "collision" and _meant_as_capsule(link, part):
                kind = "capsule"
            if kind == "mesh":
                shape = self._mesh(element, where, shape_name)
            else:
                shape = self._primitive(element, kind, where, shape_name)
            if shape is not None:
                result.append((shape_name, placement, *shape))
        return result

    def _primitive(self, element: ET.Element, kind: str, where: str, name: str) -> tuple[Any, ...] | None:
        if kind not in _PRIMITIVES:
            known = ", ".join(f"<{known}>" for known in ("mesh", *_PRIMITIVES))
            raise ValueError(f"{where}: <{element.tag}> is no shape that is known; give one of {known}")
        attributes, make = _PRIMITIVES[kind]
        if kind == "ellipsoid" and element.get("a") is not None:  # as in Drake
            attributes = {"a": 1, "b": 1, "c": 1}
        sizes: list[float] = []
        for attribute, count in attributes.items():
            sizes += (numbers := vector(element, attribute, count, where))
            if min(numbers) < 0.0:
                text = element.get(attribute)
                raise ValueError(f"{where}: {element.tag} {attribute}={text!r}: must not be negative")
        if not any(sizes):
            self._leave_out(name, f"its <{element.tag}> has no size", "give it one, or take it out")
            return None
        if not all(sizes) and not (kind == "capsule" and sizes[0]):  # a capsule without length is a sphere
            clause = f"a size of 0 of its <{element.tag}> is taken as {THINNEST:g} m"
            self.notes.append(Note(NoteKind.SHAPE, (name,), clause, "give it one", "warning"))
            sizes = [max(size, THINNEST) for size in sizes]
        return (make(*sizes),)

    def _mesh(self, element: ET.Element, where: str, name: str) -> tuple[Any, ...] | None:
        file = element.get("filename", "")
        if not file:
            raise ValueError(f"{where}: mesh filename is missing; name the file")
        scale = np.array(vector(element, "scale", 3, where, _UNSCALED))
        if not scale.all():
            raise ValueError(f"{where}: mesh scale={element.get('scale')!r}: must not be 0")
        path = find_mesh(file, self.folders)
        if path is None:
            if not (self.allow_missing or self.allow_faults):
                raise ValueError(f"{where}: mesh {file} could not be found; {MISSING}")
            clause = f"left out: a mesh in {os.path.dirname(file) or 'the folder of the file'} is missing"
            self.notes.append(Note(NoteKind.MESH, (name,), clause, _PACKAGES, "warning"))
            return None
        try:
            return self.load(path, scale), path, scale
        except ValueError as fault:
            raise ValueError(f"{where}: mesh {path}: {fault}") from None

    def _leave_out(self, name: str, why: str, remedy: str = "") -> None:
        self.notes.append(Note(NoteKind.SHAPE, (name,), f"left out: {why}", remedy, "warning"))

    def _name_strays(self, link: ET.Element, tag: str) -> None:
        """Note the shapes that no parser reads: those not directly below their link."""
        count = len(link.findall(f".//{tag}/geometry")) - len(link.findall(f"{tag}/geometry"))
        if count and tag == "collision":
            clause = f"{count} of its <{tag}> elements are left out: they stand within another element"
            remedy = "put them directly below the link"
            self.notes.append(Note(NoteKind.SHAPE, (link.get("name", ""),), clause, remedy, "warning"))


_RADIUS_AND_LENGTH = {"radius": 1, "length": 1}
_PRIMITIVES: dict[str, tuple[dict[str, int], Callable[..., Any]]] = {
    "box": ({"size": 3}, coal.Box),
    "sphere": ({"radius": 1}, coal.Sphere),
    "cylinder": (_RADIUS_AND_LENGTH, coal.Cylinder),
    "capsule": (_RADIUS_AND_LENGTH, coal.Capsule),
    "ellipsoid": ({"radii": 3}, coal.Ellipsoid),
}
"""Element: its attributes with the number of sizes [m] in each, and the constructor of the geometry. A capsule's length
is that between its caps' centres."""


def _meant_as_capsule(link: ET.Element, part: ET.Element) -> bool:
    """Return True if a <collision_checking> calls a cylinder a capsule, an extension of Pinocchio's."""
    name = part.get("name", link.get("name"))
    return any(capsule.get("name") == name for capsule in link.iterfind("collision_checking/capsule"))
