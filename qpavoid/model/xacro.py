"""Expansion of xacro files, the macro language that most URDFs of ROS are written in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from qpavoid.errors import ConfigError
from qpavoid.model.packages import find_package, mesh_folders


def is_xacro(path: Path, text: str) -> bool:
    """Return True if a robot's file has to be expanded.

    By its name, or since it holds elements of xacro.
    """
    return path.suffix == ".xacro" or "<xacro:" in text


def expand_xacro(path: Path) -> str:
    """Expand a xacro file to a URDF, with the default of every argument.

    `$(find NAME)` is looked up as `package://NAME` is, then by ROS where that is installed.

    Raises:
        ConfigError: the package `xacro` is not installed, or what it says is wrong with the file.
    """
    command = f"`xacro {path.name} > {path.name.partition('.')[0]}.urdf`"
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise ConfigError(
            f"{path}: it is written in xacro: pip install xacro, or run {command} where ROS is installed"
        ) from None
    try:
        with _packages_found(substitution_args, path):
            return str(xacro.process_file(str(path)).toxml())
    except (Exception, SystemExit) as error:  # it evaluates Python, which may raise anything
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise ConfigError(
            f"{path}: xacro: {reason}; mend it, or run {command} with the arguments that it needs and give the URDF"
        ) from None


@contextmanager
def _packages_found(substitution_args: Any, path: Path) -> Iterator[None]:
    """Let `$(find NAME)` find packages without ROS.

    xacro asks only its own index of installed packages.
    """
    original = substitution_args._eval_find
    entries = mesh_folders(path, [])

    def find(name: str) -> str:
        folder = find_package(name, entries)
        if folder is None:
            try:
                folder = str(original(name))
            except ImportError:
                raise LookupError(f"no package {name!r} beside the file or along ROS_PACKAGE_PATH") from None
        return folder

    substitution_args._eval_find = find
    try:
        yield
    finally:
        substitution_args._eval_find = original
