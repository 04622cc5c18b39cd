"""Reads URDF and MJCF files: the model, and the collision geometry with its meshes."""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.files.safe_xml import read_robot_xml
from qpavoid.files.shipped import EXAMPLES, example_robot, example_robot_data
from qpavoid.files.urdf_check import check_mjcf, check_urdf


class MimicWarning(UserWarning):
    """Joints that should follow others do not: lock them."""


_ROOT_JOINTS = {
    "fixed": lambda: None,
    "planar": pin.JointModelPlanar,
    "free_flyer": pin.JointModelFreeFlyer,
}


def find_resource(value: str, folder: Path, where: str) -> Path:
    """A URDF, SRDF or mesh that a file names.

    Args:
        value: path relative to the file, or `example-robot-data:PATH`.
        folder: that of the file.
        where: file and field, for messages.

    Raises:
        ConfigError: there is no such file.
    """
    found = example_robot(value) if value.startswith(EXAMPLES) else folder / value
    if not os.path.isfile(found):  # False where the name is one that no file can have; Path.is_file may raise
        remedy = f"give a path relative to this file or {EXAMPLES}PATH"
        raise ConfigError(f"{where}: no such file {value!r}; {remedy}")
    return found


@contextmanager
def _quiet_stderr() -> Iterator[list[str]]:
    """Catches what C++ parsers print on the process's error stream, so that one line can say it instead."""
    lines: list[str] = []
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()


def is_mjcf(path: Path) -> bool:
    """Whether a robot's file is an MJCF, by its name."""
    return path.suffix == ".xml"


def read_model(urdf: Path, root_joint: str) -> Any:
    """Pinocchio model of a URDF or MJCF.

    Joints that mimic another one have no coordinate of their own. Where Pinocchio cannot read them so (they come before
    the other one in the tree, or turn all the way round where that has limits), they move on their own, with a
    `MimicWarning`.

    Args:
        urdf: the file.
        root_joint: `fixed`, `planar` or `free_flyer`.

    Raises:
        ConfigError: not a usable file, with the parser's own reason.
    """
    kind = "MJCF" if is_mjcf(urdf) else "URDF"
    root = _ROOT_JOINTS[root_joint]()
    with _quiet_stderr() as printed:
        try:
            if kind == "MJCF":
                check_mjcf(urdf)
                return _model_of_mjcf(urdf, root)
            check_urdf(urdf)
            return _model_of_urdf(urdf, root)
        except (ValueError, RuntimeError, IndexError) as error:
            reason = _reason(error)
    first = next((line.split(":", 1)[1].strip() for line in printed if line.startswith("Error:")), "")
    raise ConfigError(f"{urdf}: not a usable {kind}: {first or reason}")


def _model_of_urdf(urdf: Path, root: Any) -> Any:
    arguments = (str(urdf),) if root is None else (str(urdf), root)
    try:
        return pin.buildModelFromUrdf(*arguments, mimic=True)
    except (ValueError, RuntimeError) as error:
        reason = _reason(error)
    model = pin.buildModelFromUrdf(*arguments, mimic=False)
    warnings.warn(
        f"{urdf}: joints that mimic others move on their own, and should be locked: {reason[-120:]}",
        MimicWarning,
        stacklevel=6,
    )
    return model


def _model_of_mjcf(mjcf: Path, root: Any) -> Any:
    with warnings.catch_warnings():  # of a change of name that older versions do not have
        warnings.simplefilter("ignore", DeprecationWarning)
        if root is None:
            return pin.buildModelFromMJCF(str(mjcf))
        return pin.buildModelFromMJCF(str(mjcf), root, "root_joint")[0]


def _reason(error: Exception) -> str:
    """The last part of what pinocchio says: before it comes where in its own source it was said."""
    if isinstance(error, IndexError):  # of a look-up in C++, without a name
        return "it refers to a class, mesh or other name that it does not define"
    return " ".join(str(error).split()).rpartition("message: ")[2].rstrip(".")


def read_pieces(urdf: Path, model: Any, package_dirs: list[str], path: Path) -> Any:
    """Collision geometry of a URDF or MJCF, or what is meant to be seen where it has none; see `read_collision`."""
    collision = read_collision(urdf, model, package_dirs, path)
    return collision if collision.ngeoms else read_collision(urdf, model, package_dirs, path, visual=True)


def read_collision(urdf: Path, model: Any, package_dirs: list[str], path: Path, visual: bool = False) -> Any:
    """Collision geometry of a URDF or MJCF, meshes as they are.

    What an MJCF fixes to its world (a floor) is no part of the robot and left out.

    Args:
        urdf: the file.
        model: its model.
        package_dirs: folders to look for meshes in first; see `mesh_folders`.
        path: file to name in errors.
        visual: what is meant to be seen instead.

    Raises:
        ConfigError: a mesh that cannot be found or read.
    """
    kind = pin.VISUAL if visual else pin.COLLISION
    folders = mesh_folders(urdf, package_dirs)
    _check_mesh_sizes(urdf, folders, path)
    with _quiet_stderr():
        try:
            if is_mjcf(urdf):
                return _without_world(pin.buildGeomFromMJCF(model, str(urdf), kind))
            return pin.buildGeomFromUrdf(model, str(urdf), kind, package_dirs=folders)
        except (ValueError, RuntimeError, IndexError) as error:
            reason = _reason(error)
    raise ConfigError(
        f"{path}: {urdf.name}: {reason}; name the folder that holds the package in `package_dirs` of a robot.yaml, "
        "or set ROS_PACKAGE_PATH"
    )


def _without_world(geometry: Any) -> Any:
    for name in [piece.name for piece in geometry.geometryObjects if piece.parentFrame == 0]:
        geometry.removeGeometryObject(name)
    return geometry


def mesh_folders(urdf: Path, package_dirs: list[str]) -> list[str]:
    """Where `package://` is looked up: given folders, above the file, example-robot-data, along ROS_PACKAGE_PATH."""
    ros = [folder for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
    above = [str(parent) for parent in urdf.resolve().parents]
    return [*package_dirs, *above, str(example_robot_data()), *ros]


def find_mesh(name: str, folders: list[str]) -> str | None:
    """The file that a mesh of a URDF is in, or None.

    Args:
        name: as the URDF has it.
        folders: see `mesh_folders`.
    """
    for scheme in ("package://", "model://"):
        if name.startswith(scheme):
            name = name.removeprefix(scheme).lstrip("/")  # some write three slashes
    name = name.removeprefix("file://")
    return next((found for folder in folders if os.path.isfile(found := os.path.join(folder, name))), None)


_LARGEST_MESH = 100_000_000
"""Size of a mesh [bytes]: the reader takes files into memory as a whole before it looks at them."""


def _check_mesh_sizes(urdf: Path, folders: list[str], path: Path) -> None:
    for name in mesh_names(urdf):
        found = find_mesh(name, folders)
        if found is not None and os.path.getsize(found) > _LARGEST_MESH:
            raise ConfigError(
                f"{path}: mesh {found}: {os.path.getsize(found)} bytes; at most {_LARGEST_MESH} are read, "
                "make it coarser"
            )


def mesh_names(urdf: Path, tag: str = "") -> list[str]:
    """Names of the mesh files of a URDF or MJCF, each once.

    Args:
        urdf: the file.
        tag: `collision` or `visual` for those of a URDF alone.
    """
    mjcf = is_mjcf(urdf)
    root = read_robot_xml(urdf, "MJCF" if mjcf else "URDF")
    meshes = root.iterfind(f".//{tag}//mesh" if tag and not mjcf else ".//mesh")
    names = (mesh.get("file" if mjcf else "filename", "") for mesh in meshes)
    return list(dict.fromkeys(name for name in names if name))


def honour_srdf(model: Any, bodies: Any, srdf: Path) -> None:
    """Removes the pairs that an SRDF disables.

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
