"""Folders of ROS packages: what `package://NAME/…` stands for, without ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from qpavoid.config.shipped import example_robot_data

_ENTRY = re.compile(r"(?P<name>[A-Za-z][\w.-]*)=(?P<folder>.+)", re.DOTALL)
"""`NAME=FOLDER`; a folder that has such a name itself is taken as a folder."""
_MANIFEST = "package.xml"
_MAX_SIBLINGS = 1000
"""Folders that are looked into for a package.xml, beside one another; workspaces have 300."""
_NAME = re.compile(r"<name>\s*([\w.-]+)\s*</name>")
_HEAD = 100_000
"""Beginning of a package.xml in which its name stands [bytes]."""


def absolute_entries(entries: Iterable[str], folder: Path) -> list[str]:
    """Make the folders of `package_dirs` (`FOLDER` or `NAME=FOLDER`) absolute, seen from a folder."""
    parts = [_split(entry, folder) for entry in entries]
    return [f"{name}={folder / place}" if name else str(folder / place) for name, place in parts]


def mesh_folders(urdf: Path, entries: Iterable[str]) -> list[str]:
    """List the folders in which a file's `package://` is looked up, in order.

    The given ones, those above the file, example-robot-data, and ROS_PACKAGE_PATH. Packages whose package.xml has
    another name than their folder stand there as `NAME=FOLDER`: the one that the file is in, those beside it, and
    those in the given folders and along ROS_PACKAGE_PATH.
    """
    entries = list(entries)
    ros = [folder for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
    above = [str(parent) for parent in urdf.resolve().parents]
    own = [folder for folder in above if os.path.isfile(os.path.join(folder, _MANIFEST))][:1]
    holders = [entry for entry in entries if not _split(entry)[0]] + [os.path.dirname(folder) for folder in own] + ros
    folders = dict.fromkeys(folder for holder in holders for folder in _with_manifest(holder))
    renamed = [
        f"{name}={folder}"
        for folder in folders
        if (name := _manifest_name(folder)) and name != os.path.basename(folder)
    ]
    return list(dict.fromkeys([*entries, *above, *renamed, str(example_robot_data()), *ros]))


def find_mesh(name: str, entries: Iterable[str]) -> str | None:
    """Find the file of a mesh name in `mesh_folders`; None if it is absent.

    A name as a URDF has it: `package://NAME/meshes/a.stl`, `file:///a.stl` or `meshes/a.stl`.
    """
    name = re.sub(r"^(package|model):///*|^file://", "", name)  # some write three slashes
    package, _, inside = name.partition("/")
    for entry in entries:
        mapped, folder = _split(entry)
        result = os.path.join(folder, inside if mapped else name)
        if mapped in ("", package) and os.path.isfile(result):
            return result
    return None


def find_package(name: str, entries: Iterable[str]) -> str | None:
    """Find the folder of a package in `mesh_folders`; None if it is absent."""
    for entry in entries:
        mapped, folder = _split(entry)
        result = folder if mapped else os.path.join(folder, name)
        if mapped in ("", name) and os.path.isdir(result):
            return result
    return None


def _split(entry: str, folder: Path = Path()) -> tuple[str, str]:
    """Split an entry into the name of a package, or nothing, and a folder."""
    match = _ENTRY.fullmatch(entry)
    if match is None or os.path.isdir(folder / entry):
        return "", entry
    return match["name"], match["folder"]


def _with_manifest(holder: str) -> Iterator[str]:
    """Yield a folder and those in it that have a package.xml."""
    try:
        inside = sorted(os.listdir(holder))[:_MAX_SIBLINGS]
    except OSError:
        return
    for folder in (holder, *(os.path.join(holder, name) for name in inside)):
        if os.path.isfile(os.path.join(folder, _MANIFEST)):
            yield folder


def _manifest_name(folder: str) -> str:
    """Read the name that a package.xml gives, or nothing; by its text, as nothing else in the file matters here."""
    try:
        with open(os.path.join(folder, _MANIFEST), encoding="utf-8", errors="replace") as file:
            match = _NAME.search(re.sub(r"<!--.*?-->", "", file.read(_HEAD), flags=re.DOTALL))
    except OSError:
        return ""
    return "" if match is None else match[1]
