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


_FILES = {
    "robot": ("robots", "*/robot.yaml"),
    "scenario": ("tasks", "*.yaml"),
    "family": ("tasks", "families/*.yaml"),
    "suite": ("tasks", "suites/*.yaml"),
    "setup": ("tasks", "families/setups/*.yaml"),
}
"""Kind of thing that ships: its folder, and where in it its files are, named by what stands for the star."""


def _shipped(kind: str) -> dict[str, Path]:
    """Return the files of all things of a kind, by name."""
    folder, pattern = _FILES[kind]
    files = data_folder(folder).glob(pattern)
    return dict(sorted((path.parent.name if "*/" in pattern else path.stem, path) for path in files))


def shipped_names(kind: str) -> list[str]:
    """List the names of what ships of a kind: `robot`, `scenario`, `family`, `suite`, or `setup` of a family."""
    return list(_shipped(kind))


def example_robot_data() -> Path:
    """Return the share folder of example-robot-data, a package of files without a module.

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        folder = distribution("example-robot-data").locate_file("cmeel.prefix/share")
    except PackageNotFoundError:
        raise ConfigError("example-robot-data is not installed: pip install example-robot-data") from None
    return Path(str(folder))


def example_robot(name: str) -> Path:
    """Return the file that `example-robot-data:PATH` stands for, even if it is absent.

    Raises:
        ConfigError: the package is not installed.
    """
    return example_robot_data() / "example-robot-data" / "robots" / name.removeprefix(EXAMPLES)


def example_listing(name: str) -> str:
    """Say what the folder holds in which the file of `example-robot-data:PATH` should be, or the nearest one above."""
    robots, path = example_robot(""), example_robot(name)
    folder = next((above for above in path.parents if above.is_relative_to(robots) and os.path.isdir(above)), robots)
    names = sorted(entry.name + "/" * entry.is_dir() for entry in folder.iterdir())
    where = folder.relative_to(robots).as_posix() if folder.is_relative_to(robots) else ""
    return f"{EXAMPLES}{where.removeprefix('.')} holds {', '.join(names)}"


def find_robot(name_or_path: str, folder: Path | None = None) -> Path:
    """Find a robot.yaml, URDF, xacro or MJCF, by shipped name or by path.

    A relative path is looked up in `folder` first.

    `example-robot-data:PATH` is a file of that package.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    if name_or_path.startswith(EXAMPLES):
        path = example_robot(name_or_path)
        if not os.path.isfile(path):
            raise ConfigError(f"{name_or_path}: no such file; {example_listing(name_or_path)}")
        return path
    if folder is not None and _looks_like_path(name_or_path) and os.path.isfile(folder / name_or_path):
        return folder / name_or_path
    return find_shipped("robot", name_or_path)


def _looks_like_path(name: str) -> bool:
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml", ".urdf", ".xml", ".xacro"))


def find_shipped(kind: str, name_or_path: str | Path) -> Path:
    """Find the path of a file of a kind, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    shipped, name = _shipped(kind), str(name_or_path)
    if name in shipped:
        return shipped[name]
    if _looks_like_path(name):
        if os.path.isfile(name):  # False where the name is one that no file can have; Path.is_file may raise
            return Path(name)
        reason = "is a folder" if os.path.isdir(name) else "no such file"
        raise ConfigError(f"{name}: {reason}; give a {kind} file, or one of {', '.join(shipped)}")
    raise UnknownName(f"unknown {kind} {name!r}{nearest(name, shipped)}")
