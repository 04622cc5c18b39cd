"""What ships, by name, and where files are that a user names: robots, scenarios, families, suites."""

from __future__ import annotations

import os.path
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from qpavoid.errors import ConfigError, UnknownName, nearest

_PACKAGE = Path(__file__).parents[1]
EXAMPLES = "example-robot-data:"
"""What a path below the robots folder of example-robot-data begins with."""


def data_folder(kind: str) -> Path:
    """Return the folder `robots` or `tasks`.

    It is packaged in a wheel, and beside the package in a checkout.
    """
    folder_in_wheel = _PACKAGE / "_data" / kind
    return folder_in_wheel if folder_in_wheel.is_dir() else _PACKAGE.parent / kind


def robot_names() -> list[str]:
    """List the names of the robots that ship."""
    return sorted(p.parent.name for p in data_folder("robots").glob("*/robot.yaml"))


def scenario_names() -> list[str]:
    """List the names of the scenarios that ship."""
    return sorted(p.stem for p in data_folder("tasks").glob("*.yaml"))


def family_names() -> list[str]:
    """List the names of the families of scenarios that ship."""
    return sorted(p.stem for p in _families().glob("*.yaml"))


def suite_names() -> list[str]:
    """List the names of the suites of the arena that ship."""
    return sorted(p.stem for p in _suites().glob("*.yaml"))


def setup_names() -> list[str]:
    """List the robots that are set up for families: a posture, and locked joints."""
    return sorted(p.stem for p in (_families() / "setups").glob("*.yaml"))


def _families() -> Path:
    return data_folder("tasks") / "families"


def _suites() -> Path:
    return data_folder("tasks") / "suites"


def example_robot_data() -> Path:
    """Return the share folder of example-robot-data, a package of files without a module.

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        share = distribution("example-robot-data").locate_file("cmeel.prefix/share")
    except PackageNotFoundError:
        raise ConfigError("example-robot-data is not installed: pip install example-robot-data") from None
    return Path(str(share))


def example_robot(name: str) -> Path:
    """Return the file that `example-robot-data:PATH` stands for, even if it is absent.

    Raises:
        ConfigError: the package is not installed.
    """
    return example_robot_data() / "example-robot-data" / "robots" / name.removeprefix(EXAMPLES)


def find_scenario(name_or_path: str | Path) -> Path:
    """Find the path of a scenario file, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return _find(str(name_or_path), "scenario", data_folder("tasks"), "{}.yaml", scenario_names())


def find_family(name_or_path: str | Path) -> Path:
    """Find the path of the file of a family of scenarios, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return _find(str(name_or_path), "family", _families(), "{}.yaml", family_names())


def find_suite(name_or_path: str | Path) -> Path:
    """Find the path of the file of a suite of the arena, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return _find(str(name_or_path), "suite", _suites(), "{}.yaml", suite_names())


def find_setup(name: str) -> Path:
    """Find the path of a shipped setup.

    Raises:
        UnknownName: there is none.
    """
    return _find(name, "setup", _families() / "setups", "{}.yaml", setup_names())


def find_robot(name_or_path: str, folder: Path | None = None) -> Path:
    """Find a robot.yaml, URDF, xacro or MJCF, by shipped name or by path.

    A relative path is looked up in `folder` first.

    `example-robot-data:PATH` is a file of that package.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    if name_or_path.startswith(EXAMPLES):
        return _find(str(example_robot(name_or_path)), "robot", Path(), "", [])
    if folder is not None and _looks_like_path(name_or_path) and os.path.isfile(folder / name_or_path):
        return folder / name_or_path
    return _find(name_or_path, "robot", data_folder("robots"), "{}/robot.yaml", robot_names())


def _looks_like_path(name: str) -> bool:
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml", ".urdf", ".xml", ".xacro"))


def _find(name: str, kind: str, folder: Path, pattern: str, names: list[str]) -> Path:
    if name in names:
        return folder / pattern.format(name)
    if _looks_like_path(name):
        path = Path(name)
        if os.path.isfile(path):  # False where the name is one that no file can have; Path.is_file may raise
            return path
        reason = "is a folder" if os.path.isdir(path) else "no such file"
        raise ConfigError(f"{name}: {reason}; give a {kind} file{', or one of ' * bool(names)}{', '.join(names)}")
    raise UnknownName(f"unknown {kind} {name!r}{nearest(name, names)}")
