"""Shapes of a URDF: every one of them becomes a coal geometry, is named where it is left out, or refused by name."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.packages import find_mesh
from qpavoid.model.urdf_check import DRAKE, check_numbers
from qpavoid.model.urdf_tree import origin, vector

THINNEST = 1e-4
"""Size that stands for one of 0, where others are not 0 [m]."""
_LARGEST_MESH = 100_000_000
"""Size of a mesh [bytes]: the reader takes files into memory as a whole before it looks at them."""
_PACKAGES = (
    "name the folder that holds the package, or NAME=FOLDER, in `package_dirs` of a robot.yaml, or set ROS_PACKAGE_PATH"
)
MISSING = f"{_PACKAGES}; `allow_missing_meshes` goes on without"
"""Remedy of a mesh that cannot be found."""


@dataclass(frozen=True)
class Meshes:
    """Where the meshes of a robot are, and what is to be done about one that is missing."""

    entries: Sequence[str]
    """See `mesh_folders`."""
    where: str
    """File to name in errors."""
    allow_missing: bool = False
    """Whether a shape whose mesh is missing is left out, with a warning, and not refused."""
    allow_faults: bool = False
    """Whether a shape that cannot be read for whatever reason is left out, with a warning, and not refused."""


def links_with_shapes(root: ET.Element, tag: str) -> list[str]:
    """List the names of the links that have at least one shape.

    Args:
        root: of a URDF.
        tag: `collision` or `visual`.
    """
    return [
        link.get("name", "")
        for link in root.findall("link")
        if any(next(_children(part), None) is not None for part in link.findall(tag))
    ]


def read_shapes(
    root: ET.Element, model: Any, meshes: Meshes, tag: str, links: Iterable[str] | None, notes: list[Note]
) -> Any:
    """Read the shapes of a URDF into a geometry model.

    A shape is called by its link and its index in it, as in `hand_0`; where one element has several, further ones have
    a second index.

    Args:
        root: of the file.
        model: Pinocchio model of it.
        meshes: where its meshes are.
        tag: `collision` or `visual`.
        links: those whose shapes are read; all if None.
        notes: what is left out or mended is added to them.

    Raises:
        ConfigError: a shape that cannot be read, or whose mesh is missing, naming link and element.
    """
    selection = None if links is None else set(links)
    geometry = pin.GeometryModel()
    of_model = {link.get("name", ""): link for link in root.findall("link")}
    for name in sorted(of_model, key=lambda name: model.getFrameId(name, pin.BODY)):  # as Pinocchio has them
        link = of_model[name]
        if selection is not None and name not in selection:
            continue
        _name_strays(link, tag, notes)
        for index, part in enumerate(link.findall(tag)):
            where = f"link {name!r}: {tag} {index}"
            try:
                _add_part(geometry, model, link, f"{name}_{index}", part, where, meshes, notes)
            except ValueError as fault:
                if not meshes.allow_faults:
                    raise ConfigError(f"{meshes.where}: {fault}") from None
                clause = f"left out: {str(fault).removeprefix(f'{where}: ')}"
                notes.append(Note(NoteKind.SHAPE, (f"{name}_{index}",), clause, severity="warning"))
    return geometry


def _add_part(
    geometry: Any,
    model: Any,
    link: ET.Element,
    name: str,
    part: ET.Element,
    where: str,
    meshes: Meshes,
    notes: list[Note],
) -> None:
    check_numbers(part, where)
    placement = origin(part, where)
    shapes = list(_children(part))
    if not shapes:
        clause = f"left out: its <{part.tag}> has no shape"
        notes.append(Note(NoteKind.SHAPE, (name,), clause, "give it one, or take the element out", "warning"))
    frame_id = model.getFrameId(link.get("name", ""), pin.BODY)
    frame = model.frames[frame_id]
    capsule_names = {capsule.get("name") for capsule in link.iterfind("collision_checking/capsule")}
    for i, element in enumerate(shapes):
        shape = name if i == 0 else f"{name}_{i}"
        if (
            element.tag == "cylinder"
            and part.tag == "collision"
            and part.get("name", link.get("name")) in capsule_names
        ):
            element = ET.Element("capsule", element.attrib)  # an extension of Pinocchio's
        shape_of_element = _make(element, where, shape, part.tag, meshes, notes)
        if shape_of_element is not None:
            made_of, path, scale = shape_of_element
            geometry.addGeometryObject(
                pin.GeometryObject(
                    shape, frame.parentJoint, frame_id, frame.placement * placement, made_of, path, np.array(scale)
                )
            )


def _children(part: ET.Element) -> Iterator[ET.Element]:
    """Yield the shapes of a <collision> or <visual>."""
    for element_of_shapes in part.findall("geometry"):
        yield from element_of_shapes


def _name_strays(link: ET.Element, tag: str, notes: list[Note]) -> None:
    """Note the shapes that no parser reads: those not directly below their link."""
    count = len([part for part in link.iter(tag) if part.find("geometry") is not None])
    count -= len([part for part in link.findall(tag) if part.find("geometry") is not None])
    if count and tag == "collision":
        clause = f"{count} of its <{tag}> elements are left out: they stand within another element"
        remedy = "put them directly below the link"
        notes.append(Note(NoteKind.SHAPE, (link.get("name", ""),), clause, remedy, "warning"))


Made = tuple[Any, str, Sequence[float]]
"""Geometry, path of its mesh or nothing, scale of that."""
_UNSCALED = (1.0, 1.0, 1.0)


def _make(element: ET.Element, where: str, name: str, tag: str, meshes: Meshes, notes: list[Note]) -> Made | None:
    """Make the geometry of a shape element; None where the shape is left out."""
    kind = element.tag.removeprefix(DRAKE)
    if kind == "mesh":
        return _make_mesh(element, where, name, meshes, notes)
    if kind not in _PRIMITIVES:
        known = ", ".join(f"<{known}>" for known in ("mesh", *_PRIMITIVES))
        raise ValueError(f"{where}: <{element.tag}> is no shape that is known; give one of {known}")
    sizes_of, make = _PRIMITIVES[kind]
    sizes = sizes_of(element, where)
    if not any(sizes):
        clause = f"left out: its <{element.tag}> has no size"
        notes.append(Note(NoteKind.SHAPE, (name,), clause, "give it one, or take it out", "warning"))
        return None
    if not all(sizes) and not (kind == "capsule" and sizes[0]):  # a capsule without length is a sphere
        clause = f"a size of 0 of its <{element.tag}> is taken as {THINNEST:g} m"
        notes.append(Note(NoteKind.SHAPE, (name,), clause, "give it one", "warning"))
        sizes = [max(size, THINNEST) for size in sizes]
    return make(*sizes), "", _UNSCALED


def _radius_and_length(element: ET.Element, where: str) -> list[float]:
    return [vector(element, attribute, 1, where, ())[0] for attribute in ("radius", "length")]


def _radii(element: ET.Element, where: str) -> list[float]:
    """Read the half axes of an ellipsoid: `radii`, or `a`, `b`, `c` as in Drake."""
    if element.get("a") is not None:
        return [vector(element, attribute, 1, where, ())[0] for attribute in "abc"]
    return vector(element, "radii", 3, where, ())


_PRIMITIVES: dict[str, tuple[Callable[[ET.Element, str], list[float]], Callable[..., Any]]] = {
    "box": (lambda element, where: vector(element, "size", 3, where, ()), coal.Box),
    "sphere": (lambda element, where: vector(element, "radius", 1, where, ()), coal.Sphere),
    "cylinder": (_radius_and_length, coal.Cylinder),
    "capsule": (_radius_and_length, coal.Capsule),
    "ellipsoid": (_radii, coal.Ellipsoid),
}
"""Element: its sizes [m], and the constructor of the geometry. A capsule's length is that between its caps' centres."""


def _make_mesh(element: ET.Element, where: str, name: str, meshes: Meshes, notes: list[Note]) -> Made | None:
    file = element.get("filename", "")
    if not file:
        raise ValueError(f"{where}: mesh filename is missing; name the file")
    scale = vector(element, "scale", 3, where, _UNSCALED)
    path = find_mesh(file, meshes.entries)
    if path is None:
        if not (meshes.allow_missing or meshes.allow_faults):
            raise ValueError(f"{where}: mesh {file} could not be found; {MISSING}")
        clause = f"left out: a mesh in {os.path.dirname(file) or 'the folder of the file'} is missing"
        notes.append(Note(NoteKind.MESH, (name,), clause, _PACKAGES, "warning"))
        return None
    size = os.path.getsize(path)
    if size > _LARGEST_MESH:
        raise ValueError(f"{where}: mesh {path}: {size} bytes; at most {_LARGEST_MESH} are read, make it coarser")
    try:
        return coal.MeshLoader().load(path, np.array(scale)), path, scale
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split()).rpartition("message: ")[2].rstrip(".")
        raise ValueError(f"{where}: mesh {path}: {_pointer(path) or f'{reason}; export it again'}") from None


def _pointer(path: str) -> str:
    """Explain a file that only stands for one in a store of large files.

    Empty for any other file.
    """
    with open(path, "rb") as file:
        if file.read(40).startswith(b"version https://git-lfs"):
            return "it is a pointer of Git LFS and no mesh; run `git lfs pull`"
    return ""
