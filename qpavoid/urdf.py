"""Reads URDF files: the model, and the collision geometry with its meshes."""

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
from qpavoid.loading import example_robot_data
from qpavoid.safe_xml import read_robot_xml
from qpavoid.urdf_check import check_urdf


class MimicWarning(UserWarning):
    """Joints that should follow others do not: lock them."""


_ROOT_JOINTS = {
    "fixed": lambda: None,
    "planar": pin.JointModelPlanar,
    "free_flyer": pin.JointModelFreeFlyer,
}


def find_resource(value: str, path: Path, field: str) -> Path:
    """A URDF or SRDF named in a robot.yaml.

    Args:
        value: path relative to the robot.yaml, or `example-robot-data:PATH`.
        path: the robot.yaml.
        field: which of its fields, for messages.

    Raises:
        ConfigError: there is no such file.
    """
    prefix = "example-robot-data:"
    if value.startswith(prefix):
        found = example_robot_data() / "example-robot-data" / "robots" / value.removeprefix(prefix)
    else:
        found = path.parent / value
    if not os.path.isfile(found):  # False where the name is one that no file can have; Path.is_file may raise
        raise ConfigError(f"{path}: {field}: no such file {value!r}; give a path relative to this file or {prefix}PATH")
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


def read_model(urdf: Path, root_joint: str) -> Any:
    """Pinocchio model of a URDF.

    Joints that mimic another one have no coordinate of their own. Where Pinocchio cannot read them so (they come before
    the other one in the tree, or turn all the way round where that has limits), they move on their own, with a
    `MimicWarning`.

    Args:
        urdf: the file.
        root_joint: `fixed`, `planar` or `free_flyer`.

    Raises:
        ConfigError: not a usable URDF, with the parser's own reason.
    """
    check_urdf(urdf)
    root = _ROOT_JOINTS[root_joint]()
    arguments = (str(urdf),) if root is None else (str(urdf), root)
    for mimic in (True, False):
        with _quiet_stderr() as printed:
            try:
                model = pin.buildModelFromUrdf(*arguments, mimic=mimic)
            except (ValueError, RuntimeError) as error:
                reason = " ".join(str(error).split())
                continue
        if not mimic:
            warnings.warn(
                f"{urdf}: joints that mimic others move on their own, and should be locked: {reason[-120:]}",
                MimicWarning,
                stacklevel=5,
            )
        return model
    first = next((line.split(":", 1)[1].strip() for line in printed if line.startswith("Error:")), "")
    raise ConfigError(f"{urdf}: not a usable URDF: {first or reason}")


def read_collision(urdf: Path, model: Any, package_dirs: list[str], path: Path) -> Any:
    """Collision geometry of a URDF, meshes as they are.

    `package://` is looked up in the given folders, above the URDF, in example-robot-data and along ROS_PACKAGE_PATH.

    Args:
        urdf: the file.
        model: its model.
        package_dirs: folders to look in first.
        path: file to name in errors.

    Raises:
        ConfigError: a mesh that cannot be found or read.
    """
    ros = [folder for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
    above = [str(parent) for parent in urdf.resolve().parents]
    folders = [*package_dirs, *above, str(example_robot_data()), *ros]
    _check_mesh_sizes(urdf, folders, path)
    with _quiet_stderr():
        try:
            return pin.buildGeomFromUrdf(model, str(urdf), pin.COLLISION, package_dirs=folders)
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split()).rstrip(".")
    raise ConfigError(
        f"{path}: {urdf.name}: {reason}; name the folder that holds the package in `package_dirs` of a robot.yaml, "
        "or set ROS_PACKAGE_PATH"
    )


_LARGEST_MESH = 100_000_000
"""Size of a mesh [bytes]: the reader takes files into memory as a whole before it looks at them."""


def _check_mesh_sizes(urdf: Path, folders: list[str], path: Path) -> None:
    for mesh in read_robot_xml(urdf, "URDF").iter("mesh"):
        name = mesh.get("filename", "").removeprefix("package://").removeprefix("file://")
        for found in (os.path.join(folder, name) for folder in folders):
            if os.path.isfile(found) and os.path.getsize(found) > _LARGEST_MESH:
                raise ConfigError(
                    f"{path}: mesh {found}: {os.path.getsize(found)} bytes; at most {_LARGEST_MESH} are read, "
                    "make it coarser"
                )


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
            reason = " ".join(str(error).split())
    raise ConfigError(f"{srdf}: not a usable SRDF: {reason}")
