"""Expansion of xacro files, the macro language that most URDFs of ROS are written in."""

from __future__ import annotations

from pathlib import Path

from qpavoid.errors import ConfigError
from qpavoid.model.packages import find_package, mesh_folders


def is_xacro(path: Path, text: str) -> bool:
    """Return True if a robot's file has to be expanded, by its name or since it holds elements of xacro."""
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
    original, entries = substitution_args._eval_find, mesh_folders(path, [])

    def find(name: str) -> str:
        if (folder := find_package(name, entries)) is not None:
            return folder
        try:
            return str(original(name))
        except ImportError:
            raise LookupError(f"no package {name!r} beside the file or along ROS_PACKAGE_PATH") from None

    substitution_args._eval_find = find  # by itself, xacro asks only its own index of installed packages
    try:
        return str(xacro.process_file(str(path)).toxml())
    except (Exception, SystemExit) as error:  # it evaluates Python, which may raise anything
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise ConfigError(
            f"{path}: xacro: {reason}; mend it, or run {command} with the arguments that it needs and give the URDF"
        ) from None
    finally:
        substitution_args._eval_find = original
