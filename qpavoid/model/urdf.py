"""URDF and MJCF files: the model, and the collision geometry with its meshes."""

from __future__ import annotations

import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pinocchio as pin

from qpavoid.config.shipped import EXAMPLES, example_robot
from qpavoid.errors import ConfigError
from qpavoid.model.enclosed_shapes import remove_enclosed
from qpavoid.model.mjcf import check_elements, model_of_mjcf, shapes_of_mjcf
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.packages import mesh_folders
from qpavoid.model.urdf_check import check_mjcf, check_urdf
from qpavoid.model.urdf_shapes import MISSING, Meshes, links_with_shapes, read_shapes
from qpavoid.model.urdf_tree import tree_xml
from qpavoid.model.xml_file import read_robot_xml, undeclared_prefixes

_ROOT_JOINTS = {
    "fixed": lambda: None,
    "planar": pin.JointModelPlanar,
    "free_flyer": pin.JointModelFreeFlyer,
}


def find_resource(value: str, folder: Path, where: str) -> Path:
    """Find a URDF, SRDF or mesh that a file names.

    Args:
        value: path relative to the file, or `example-robot-data:PATH`.
        folder: that of the file.
        where: file and field, for messages.

    Raises:
        ConfigError: there is no such file.
    """
    result = example_robot(value) if value.startswith(EXAMPLES) else folder / value
    if not os.path.isfile(result):  # False where the name is one that no file can have; Path.is_file may raise
        remedy = f"give a path relative to this file or {EXAMPLES}PATH"
        raise ConfigError(f"{where}: no such file {value!r}; {remedy}")
    return result


@contextmanager
def _quiet_stderr() -> Iterator[list[str]]:
    """Catch what C++ parsers print on the process's error stream.

    One line of an error can then say it instead.
    """
    lines: list[str] = []
    sys.stderr.flush()
    stderr_copy = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(stderr_copy, 2)
            os.close(stderr_copy)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()


def is_mjcf(path: Path) -> bool:
    """Return True if a robot's file is an MJCF, by its name."""
    return path.suffix == ".xml"


def read_model(urdf: Path, root_joint: str, notes: list[Note] | None = None) -> Any:
    """Read the Pinocchio model of a URDF (also in xacro) or MJCF.

    Joints that mimic another one have no coordinate of their own. Where Pinocchio cannot read them so (they come before
    the other one in the tree, or are continuous where that has limits), they move on their own.

    Args:
        urdf: the file.
        root_joint: `fixed`, `planar` or `free_flyer`.
        notes: what was mended or left out is added to them.

    Raises:
        ConfigError: not a usable file, with the parser's own reason, or one that it passes over.
    """
    notes = [] if notes is None else notes
    kind = "MJCF" if is_mjcf(urdf) else "URDF"
    root = _ROOT_JOINTS[root_joint]()
    xml = read_robot_xml(urdf, kind)
    if kind == "MJCF":
        check_mjcf(urdf)
        check_elements(urdf, xml)
    else:
        check_urdf(urdf)
        _name_prefixes(xml, notes)
    model, reason = None, ""
    with _quiet_stderr() as messages:
        try:
            model = model_of_mjcf(urdf, root) if kind == "MJCF" else _model_of_urdf(tree_xml(xml, notes), root, notes)
        except (ValueError, RuntimeError, IndexError) as error:
            reason = _reason(error)
    first = next((line.split(":", 1)[1].strip() for line in messages if line.startswith("Error:")), "")
    if model is None or first:
        raise ConfigError(f"{urdf}: not a usable {kind}: {first or reason}")
    for link in xml.findall("link"):
        if not model.existFrame(link.get("name", ""), pin.BODY):
            raise ConfigError(f"{urdf}: not a usable {kind}: link {link.get('name')!r} was lost by the parser")
    return model


def _name_prefixes(root: ET.Element, notes: list[Note]) -> None:
    if prefixes := undeclared_prefixes(root):
        clause = "prefix of XML that no xmlns attribute declares: it is read all the same, without what other tools add"
        remedy = 'declare it in the root, as in xmlns:drake="http://drake.mit.edu"'
        notes.append(Note(NoteKind.FILE, tuple(prefixes), clause, remedy, "warning"))


def _model_of_urdf(xml: str, root: Any, notes: list[Note]) -> Any:
    arguments = (xml,) if root is None else (xml, root)
    try:
        return pin.buildModelFromXML(*arguments, mimic=True)
    except (ValueError, RuntimeError) as error:
        reason = _reason(error)
    model = pin.buildModelFromXML(*arguments, mimic=False)
    joints = tuple(joint.get("name", "") for joint in ET.fromstring(xml).iterfind("joint") if _mimics(joint))
    clause = f"should follow others (mimic), and move on their own: {reason[-120:]}"
    notes.append(Note(NoteKind.JOINT, joints, clause, "hold them under `lock`", "warning"))
    return model


def _mimics(joint: ET.Element) -> bool:
    return joint.find("mimic") is not None and joint.get("type") != "fixed"


def _reason(error: Exception) -> str:
    """Return the last part of a message of Pinocchio's.

    What precedes it is a place in its own source.
    """
    if isinstance(error, IndexError):  # of a look-up in C++, without a name
        return "it refers to a class, mesh or other name that it does not define"
    return " ".join(str(error).split()).rpartition("message: ")[2].rstrip(".")


def read_pieces(
    urdf: Path,
    model: Any,
    package_dirs: Sequence[str],
    path: Path,
    notes: list[Note] | None = None,
    *,
    visuals: bool = True,
    allow_missing: bool = False,
    enclosed: bool = False,
) -> Any:
    """Read the collision geometry of a URDF or MJCF; visual geometry of links without any.

    A shape that lies inside another one of its link is left out: nothing can touch it.

    Args:
        urdf: the file.
        model: its model.
        package_dirs: folders to look for meshes in first, and `NAME=FOLDER`; see `mesh_folders`.
        path: file to name in errors.
        notes: what was left out or replaced is added to them.
        visuals: whether links without collision geometry get their visual geometry.
        allow_missing: whether shapes whose meshes are missing are left out.
        enclosed: whether shapes inside others are kept.

    Raises:
        ConfigError: a shape that cannot be read or found.
    """
    notes = [] if notes is None else notes
    pieces = read_collision(urdf, model, package_dirs, path, notes=notes, allow_missing=allow_missing)
    if visuals:
        _add_visuals(pieces, urdf, model, package_dirs, path, notes, allow_missing)
    return pieces if enclosed else remove_enclosed(pieces, notes)


def _add_visuals(
    pieces: Any, urdf: Path, model: Any, package_dirs: Sequence[str], path: Path, notes: list[Note], allow_missing: bool
) -> None:
    """Add the visual geometry of the links that have no collision geometry."""
    links_with_collision = {piece.parentFrame for piece in pieces.geometryObjects}
    if is_mjcf(urdf):
        visual_model = read_collision(urdf, model, package_dirs, path, visual=True)
        result = [piece for piece in visual_model.geometryObjects if piece.parentFrame not in links_with_collision]
    else:
        root = read_robot_xml(urdf, "URDF")
        visual_links = links_with_shapes(root, "visual")
        links = [link for link in visual_links if model.getFrameId(link, pin.BODY) not in links_with_collision]
        meshes = Meshes(mesh_folders(urdf, package_dirs), str(path), allow_missing, bool(links_with_collision))
        with _quiet_stderr():
            result = list(read_shapes(root, model, meshes, "visual", links, notes).geometryObjects)
    for piece in result:
        pieces.addGeometryObject(piece)
    if result:
        names = tuple(dict.fromkeys(model.frames[piece.parentFrame].name for piece in result))
        clause = "no collision shape: what is meant to be seen of it serves instead"
        remedy = "list bodies of your own, or set `visuals: false` where nothing can be hit"
        notes.append(Note(NoteKind.LINK, names, clause, remedy, "warning"))


def read_collision(
    urdf: Path,
    model: Any,
    package_dirs: Sequence[str],
    path: Path,
    visual: bool = False,
    notes: list[Note] | None = None,
    allow_missing: bool = False,
) -> Any:
    """Read the collision geometry of a URDF or MJCF, meshes as they are.

    What an MJCF fixes to its world (a floor) is no part of the robot and left out.

    Args:
        urdf: the file.
        model: its model.
        package_dirs: folders to look for meshes in first, and `NAME=FOLDER`; see `mesh_folders`.
        path: file to name in errors.
        visual: whether visual geometry is read instead.
        notes: what was left out or mended is added to them.
        allow_missing: whether shapes whose meshes are missing are left out.

    Raises:
        ConfigError: a shape that cannot be read or found.
    """
    notes = [] if notes is None else notes
    root = read_robot_xml(urdf, "MJCF" if is_mjcf(urdf) else "URDF")
    with _quiet_stderr():
        if not is_mjcf(urdf):
            meshes = Meshes(mesh_folders(urdf, package_dirs), str(path), allow_missing)
            return read_shapes(root, model, meshes, "visual" if visual else "collision", None, notes)
        try:
            return shapes_of_mjcf(urdf, root, model, visual)
        except (ValueError, RuntimeError, IndexError) as error:
            reason = _reason(error)
    raise ConfigError(f"{path}: {urdf.name}: {reason}; {MISSING}")


def mesh_names(urdf: Path, tag: str = "") -> list[str]:
    """List the mesh files of a URDF or MJCF, each once.

    Args:
        urdf: the file.
        tag: `collision` or `visual` for those of a URDF alone.
    """
    mjcf = is_mjcf(urdf)
    root = read_robot_xml(urdf, "MJCF" if mjcf else "URDF")
    meshes = root.iterfind(f".//{tag}//mesh" if tag and not mjcf else ".//mesh")
    names = (mesh.get("file" if mjcf else "filename", "") for mesh in meshes)
    return list(dict.fromkeys(name for name in names if name))


def apply_srdf(model: Any, bodies: Any, srdf: Path) -> None:
    """Remove the pairs that an SRDF disables.

    Args:
        model: pinocchio model.
        bodies: its collision bodies with their pairs, changed in place.
        srdf: the file.

    Raises:
        ConfigError: not a usable SRDF.
    """
    read_robot_xml(srdf, "SRDF")
    with _quiet_stderr():
        try:
            pin.removeCollisionPairs(model, bodies, str(srdf), False)
            return
        except (ValueError, RuntimeError) as error:
            reason = _reason(error)
    raise ConfigError(f"{srdf}: not a usable SRDF: {reason}")
