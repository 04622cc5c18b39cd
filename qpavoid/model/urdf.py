"""URDF and MJCF files: the model, and the collision geometry with its meshes."""

from __future__ import annotations

import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import coal
import pinocchio as pin

from qpavoid.config.shipped import EXAMPLES, example_listing, example_robot
from qpavoid.errors import ConfigError
from qpavoid.model.mjcf import check_mjcf, read_geoms, read_mjcf
from qpavoid.model.notes import Note, NoteKind
from qpavoid.model.packages import mesh_folders
from qpavoid.model.shape_checks import remove_enclosed
from qpavoid.model.urdf_shapes import MISSING, ShapeReader
from qpavoid.model.urdf_tree import tree_xml
from qpavoid.model.xml_file import read_robot_xml, undeclared_prefixes

_ROOT_JOINTS = {
    "fixed": lambda: None,
    "planar": pin.JointModelPlanar,
    "free_flyer": pin.JointModelFreeFlyer,
}


def find_resource(value: str, folder: Path, where: str) -> Path:
    """Find a URDF, SRDF or mesh that a file names: by a path relative to its folder, or `example-robot-data:PATH`.

    Raises:
        ConfigError: there is no such file; naming file and field.
    """
    result = example_robot(value) if value.startswith(EXAMPLES) else folder / value
    if not os.path.isfile(result):  # False where the name is one that no file can have; Path.is_file may raise
        remedy = f"give a path relative to this file or {EXAMPLES}PATH"
        if value.startswith(EXAMPLES):
            remedy = example_listing(value)
        raise ConfigError(f"{where}: no such file {value!r}; {remedy}")
    return result


def is_mjcf(path: Path) -> bool:
    """Return True if a robot's file is an MJCF, by its name."""
    return path.suffix == ".xml"


def _root(path: Path) -> ET.Element:
    return read_robot_xml(path, "MJCF" if is_mjcf(path) else "URDF")


def read_model(urdf: Path, root_joint: str, notes: list[Note] | None = None) -> Any:
    """Read the Pinocchio model of a URDF (also in xacro) or MJCF on a `fixed`, `planar` or `free_flyer` root joint.

    Joints that mimic another one have no coordinate of their own. Where Pinocchio cannot read them so (they come before
    the other one in the tree, or are continuous where that has limits), they move on their own. What was mended or left
    out is added to the notes.

    Raises:
        ConfigError: not a usable file, with the parser's own reason, or one that it passes over.
    """
    notes = [] if notes is None else notes
    xml, root = _root(urdf), _ROOT_JOINTS[root_joint]()
    where = f"{urdf}: not a usable {'MJCF' if is_mjcf(urdf) else 'URDF'}"
    try:
        if is_mjcf(urdf):
            check_mjcf(xml)
            build = partial(read_mjcf, urdf, root)
        else:
            _name_prefixes(xml, notes)
            build = partial(_model_of_urdf, tree_xml(xml, notes), root, notes)
    except ValueError as fault:
        raise ConfigError(f"{where}: {fault}") from None
    return _parsed(build, where)


def _name_prefixes(root: ET.Element, notes: list[Note]) -> None:
    if prefixes := undeclared_prefixes(root):
        clause = "prefix of XML that no xmlns attribute declares: it is read all the same, without what other tools add"
        remedy = 'declare it in the root, as in xmlns:drake="http://drake.mit.edu"'
        notes.append(Note(NoteKind.FILE, tuple(prefixes), clause, remedy, "warning"))


def _model_of_urdf(tree: str, root: Any, notes: list[Note]) -> Any:
    arguments = (tree,) if root is None else (tree, root)
    try:
        return pin.buildModelFromXML(*arguments, mimic=True)
    except (ValueError, RuntimeError) as error:
        reason = _reason(error)
    model = pin.buildModelFromXML(*arguments, mimic=False)
    joints = tuple(
        joint.get("name", "") for joint in ET.fromstring(tree).iterfind("joint[mimic]") if joint.get("type") != "fixed"
    )
    clause = f"should follow others (mimic), and move on their own: {reason[-120:]}"
    notes.append(Note(NoteKind.JOINT, joints, clause, "hold them under `lock`", "warning"))
    return model


def _parsed(parse: Callable[[], Any], where: str, remedy: str = "") -> Any:
    """Return what a C++ parser makes of a file; what it prints on the process's error stream is caught.

    Raises:
        ConfigError: it raises an error, or prints one; in one line.
    """
    result, reason = None, ""
    sys.stderr.flush()
    stderr_copy = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            result = parse()
        except (ValueError, RuntimeError, IndexError) as error:
            reason = _reason(error)
        finally:
            os.dup2(stderr_copy, 2)
            os.close(stderr_copy)
        file.seek(0)
        printed = file.read().decode(errors="replace").splitlines()
    reason = next((line.split(":", 1)[1].strip() for line in printed if line.startswith("Error:")), reason)
    if reason:
        raise ConfigError(f"{where}: {reason}{remedy}")
    return result


def _reason(error: Exception) -> str:
    """Return the last part of a message of Pinocchio's, which begins with a place in its own source."""
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
    """Read the collision geometry of a URDF or MJCF, meshes as they are; visual geometry of links without any.

    A shape that lies inside another one of its link is left out: nothing can touch it. So is what an MJCF fixes to its
    world (a floor), which is no part of the robot.

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
    notes, root = [] if notes is None else notes, _root(urdf)
    folders = [] if is_mjcf(urdf) else mesh_folders(urdf, package_dirs)

    def read(tag: str, skipped: set[int], allow_faults: bool = False) -> Any:
        if is_mjcf(urdf):
            return read_geoms(urdf, root, model, tag == "visual")
        return ShapeReader(model, folders, str(path), notes, allow_missing, allow_faults).read(root, tag, skipped)

    where, remedy = f"{path}: {urdf.name}", f"; {MISSING}"
    pieces = _parsed(lambda: read("collision", set()), where, remedy)
    if visuals:
        with_collision = {piece.parentFrame for piece in pieces.geometryObjects}
        shapes = _parsed(lambda: read("visual", with_collision, bool(with_collision)), where, remedy).geometryObjects
        added = [piece for piece in shapes if piece.parentFrame not in with_collision]
        for piece in added:
            pieces.addGeometryObject(piece)
        if added:
            names = tuple(dict.fromkeys(model.frames[piece.parentFrame].name for piece in added))
            clause = "no collision shape: what is meant to be seen of it serves instead"
            remedy = "list bodies of your own, or set `visuals: false` where nothing can be hit"
            notes.append(Note(NoteKind.LINK, names, clause, remedy, "warning"))
    return pieces if enclosed else remove_enclosed(pieces, notes)


def missing_meshes(
    urdf: Path, model: Any, package_dirs: Sequence[str], visuals: bool = True
) -> tuple[list[Note], list[str]]:
    """Note the shapes of a URDF whose mesh cannot be found, and list the links with others; loads no mesh.

    Args:
        urdf: the file; an MJCF finds its meshes by its own rules, and gives neither.
        model: its model.
        package_dirs: folders to look for meshes in first, and `NAME=FOLDER`.
        visuals: whether what is meant to be seen counts, of links without collision geometry.
    """
    notes: list[Note] = []
    if is_mjcf(urdf):
        return notes, []
    reader = ShapeReader(
        model, mesh_folders(urdf, package_dirs), str(urdf), notes, allow_faults=True, load=lambda *_: coal.Sphere(1.0)
    )
    frames = {piece.parentFrame for piece in reader.read(_root(urdf), "collision").geometryObjects}
    if visuals:
        frames |= {piece.parentFrame for piece in reader.read(_root(urdf), "visual", frames).geometryObjects}
    links = [model.frames[frame].name for frame in sorted(frames)]
    return [note for note in notes if note.kind is NoteKind.MESH], links


def mesh_names(urdf: Path, tag: str = "") -> list[str]:
    """List the mesh files of a URDF (of its `collision` or `visual` elements alone) or MJCF, each once."""
    meshes = _root(urdf).iterfind(f".//{tag}//mesh" if tag and not is_mjcf(urdf) else ".//mesh")
    names = (mesh.get("file" if is_mjcf(urdf) else "filename", "") for mesh in meshes)
    return list(dict.fromkeys(name for name in names if name))


def apply_srdf(model: Any, bodies: Any, srdf: Path) -> None:
    """Remove the pairs of bodies that an SRDF disables.

    Raises:
        ConfigError: not a usable SRDF.
    """
    read_robot_xml(srdf, "SRDF")
    _parsed(lambda: pin.removeCollisionPairs(model, bodies, str(srdf), False), f"{srdf}: not a usable SRDF")
