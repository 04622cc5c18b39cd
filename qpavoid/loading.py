"""Finds and reads robot and scenario files, applies `--set` overrides, and says what is wrong in one line."""

from __future__ import annotations

import difflib
import os.path
import typing
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from qpavoid.config import ScenarioConfig, expand_solver
from qpavoid.errors import ConfigError, UnknownName
from qpavoid.files import read_text
from qpavoid.safe_yaml import parse_yaml

Config = TypeVar("Config", bound=BaseModel)
_PACKAGE = Path(__file__).parent
_LARGEST = 1_000_000
"""Size of a YAML file [bytes]; those that ship take 3000."""


def data_folder(kind: str) -> Path:
    """The folder `robots` or `tasks`: packaged in a wheel, beside the package in a checkout."""
    packaged = _PACKAGE / "_data" / kind
    return packaged if packaged.is_dir() else _PACKAGE.parent / kind


def robot_names() -> list[str]:
    """Names of the robots that ship."""
    return sorted(p.parent.name for p in data_folder("robots").glob("*/robot.yaml"))


def scenario_names() -> list[str]:
    """Names of the scenarios that ship."""
    return sorted(p.stem for p in data_folder("tasks").glob("*.yaml"))


def family_names() -> list[str]:
    """Names of the families of scenarios that ship."""
    return sorted(p.stem for p in _families().glob("*.yaml"))


def suite_names() -> list[str]:
    """Names of the suites of the arena that ship."""
    return sorted(p.stem for p in _suites().glob("*.yaml"))


def setup_names() -> list[str]:
    """Names of the robots that are set up for families: a posture, and what is held."""
    return sorted(p.stem for p in (_families() / "setups").glob("*.yaml"))


def _families() -> Path:
    return data_folder("tasks") / "families"


def _suites() -> Path:
    return data_folder("tasks") / "suites"


def example_robot_data() -> Path:
    """Share folder of example-robot-data (a package of files without a Python module).

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        share = distribution("example-robot-data").locate_file("cmeel.prefix/share")
    except PackageNotFoundError:
        raise ConfigError("example-robot-data is not installed: pip install example-robot-data") from None
    return Path(str(share))


EXAMPLES = "example-robot-data:"
"""What a path below the robots folder of example-robot-data begins with."""


def example_robot(name: str) -> Path:
    """The file that `example-robot-data:PATH` stands for, whether it exists or not.

    Raises:
        ConfigError: the package is not installed.
    """
    return example_robot_data() / "example-robot-data" / "robots" / name.removeprefix(EXAMPLES)


def nearest(name: str, valid: Iterable[str]) -> str:
    """`; did you mean 'x'?` with the nearest valid name, or the list of the valid ones."""
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; valid are {', '.join(names)}" if names else ""


def find_scenario(name_or_path: str | Path) -> Path:
    """Path of a scenario file, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return _find(str(name_or_path), "scenario", data_folder("tasks"), "{}.yaml", scenario_names())


def find_family(name_or_path: str | Path) -> Path:
    """Path of the file of a family of scenarios, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return _find(str(name_or_path), "family", _families(), "{}.yaml", family_names())


def find_suite(name_or_path: str | Path) -> Path:
    """Path of the file of a suite of the arena, given by shipped name or by path.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    return _find(str(name_or_path), "suite", _suites(), "{}.yaml", suite_names())


def find_setup(name: str) -> Path:
    """Path of a shipped setup.

    Raises:
        UnknownName: there is none.
    """
    return _find(name, "setup", _families() / "setups", "{}.yaml", setup_names())


def find_robot(name_or_path: str, folder: Path | None = None) -> Path:
    """Path of a robot.yaml, URDF or MJCF, given by shipped name or by path (relative paths: from `folder` first).

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
    return "/" in name or "\\" in name or name.endswith((".yaml", ".yml", ".urdf", ".xml"))


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


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), solver: str | None = None) -> ScenarioConfig:
    """Reads a scenario.

    Args:
        name_or_path: shipped name or path of a YAML file.
        overrides: `path=value` strings such as `avoidance.d2=0.30`; the value is YAML, `tasks.0.gain=3` indexes a
            list.
        solver: replaces the scenario's solver, as in `eq10` or `qp:proxqp`; settings of the file stay where the
            name is the same.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    path = find_scenario(name_or_path)
    return read_config(path, ScenarioConfig, overrides, solver).read_from(path)


def read_config(path: Path, model: type[Config], overrides: Sequence[str] = (), solver: str | None = None) -> Config:
    """Reads a YAML file into `model`.

    Raises:
        ConfigError: unreadable file, bad YAML, unknown key (with the nearest valid one) or bad value.
    """
    data = read_mapping(path)
    if solver is not None:
        wanted, kept = _solver_mapping(solver), _solver_mapping(data.get("solver"))
        data["solver"] = {**kept, **wanted} if kept.get("name") == wanted["name"] else wanted
    for override in overrides:
        _set(data, override, path)
    return validate(data, model, path)


def validate(data: dict[str, Any], model: type[Config], path: Path) -> Config:
    """`data` as a configuration.

    Args:
        data: fields of a file, or what stands for one.
        model: the configuration.
        path: file to name in errors.

    Raises:
        ConfigError: unknown key (with the nearest valid one) or bad value.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_explain(error, model, data)}") from None


def _solver_mapping(value: Any) -> dict[str, Any]:
    """The mapping that a solver's short form stands for."""
    expanded = expand_solver("qp" if value is None else value)
    return dict(expanded) if isinstance(expanded, dict) else {}


def read_mapping(path: Path) -> dict[str, Any]:
    """The fields of a YAML file, as they stand there.

    Raises:
        ConfigError: unreadable file, bad YAML, or something else than a mapping.
    """
    text = read_text(path, _LARGEST)
    try:
        data = parse_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: must be a mapping of fields, got {type(data).__name__}")
    return data


def _set(data: dict[str, Any], override: str, path: Path) -> None:
    """Applies `a.b.0.c=value` in place; missing mappings on the way are made, so that defaults can be set."""
    where, equals, text = override.partition("=")
    if not equals or not where:
        raise ConfigError(f"--set {override!r}: expected path=value, as in avoidance.d2=0.30")
    try:
        value = parse_yaml(text)
    except ValueError:
        raise ConfigError(f"--set {override!r}: {text!r} is not a YAML value") from None
    node: Any = data
    keys = where.split(".")
    for depth, key in enumerate(keys):
        last = depth == len(keys) - 1
        if isinstance(node, list):
            if not key.isdecimal() or len(key) > 9 or int(key) >= len(node):
                raise ConfigError(f"{path}: --set {where}: {key!r} is not an index below {len(node)}")
            index: Any = int(key)
        elif isinstance(node, dict):
            index = key
            if not last and not isinstance(node.get(key), dict | list):
                node[key] = _solver_mapping(node.get(key)) if key == "solver" else {}
        else:
            raise ConfigError(f"{path}: --set {where}: there is nothing below {'.'.join(keys[:depth])}")
        if last:
            node[index] = value
        else:
            node = node[index]


def _explain(error: ValidationError, model: type[BaseModel], data: dict[str, Any]) -> str:
    """All faults of a file in one line: field, what is wrong, nearest valid key."""
    faults = [(tuple(_field(fault["loc"], fault["type"], data)), fault) for fault in error.errors()]
    # Of a field that may be a list or a mapping, pydantic reports both; the one that was meant got deeper.
    above = {field[:depth] for field, _ in faults for depth in range(len(field))}
    deepest = [(field, fault) for field, fault in faults if field not in above]
    more = f"; and {len(deepest) - _FAULTS_TOLD} more" if len(deepest) > _FAULTS_TOLD else ""
    told = [(".".join(field), _fault(fault, model)) for field, fault in deepest[:_FAULTS_TOLD]]
    return "; ".join(f"{field}: {what}" if field else what for field, what in told) + more


_FAULTS_TOLD = 5


def _field(loc: tuple[int | str, ...], kind: str, data: Any) -> list[str]:
    """The keys and indices of the file among a location's parts; pydantic also names the members of unions."""
    field = []
    for part in loc:
        try:
            data = data[part]
        except (LookupError, TypeError):
            continue
        field.append(str(part))
    absent = kind == "missing" or (kind == "extra_forbidden" and field[-1] != loc[-1])  # the latter: `eq10:daqp`
    return [*field, str(loc[-1])] if absent else field


def _fault(fault: ErrorDetails, model: type[BaseModel]) -> str:
    """What is wrong, in words."""
    kind, loc, context = fault["type"], fault["loc"], fault.get("ctx", {})
    if kind == "extra_forbidden":
        keys = {key for block in _blocks_at(model, loc[:-1]) for key in block.model_fields}
        return f"unknown key{nearest(str(loc[-1]), keys)}"
    if kind == "missing":
        return "is missing"
    if kind in ("model_type", "model_attributes_type"):
        return f"must be a mapping of fields, got {fault['input']!r:.60}"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        key = str(context["discriminator"]).strip("'")
        tags = sorted(tag for block in _blocks_at(model, loc) for tag in _tags(block))
        if kind == "union_tag_not_found":
            return f"`{key}` is missing; valid are {', '.join(tags)}"
        return f"unknown {key} {context['tag']!r}{nearest(str(context['tag']), tags)}"
    if kind == "value_error":
        return fault["msg"].removeprefix("Value error, ")
    remedy = _REMEDIES.get(kind)
    return f"{fault['msg']}, got {fault['input']!r:.60}" + (f": {remedy}" if remedy else "")


_NUMBER = "give a number alone, in m, rad, kg and s"
_REMEDIES = {
    "float_parsing": _NUMBER,
    "float_type": _NUMBER,
    "dict_type": "give a mapping by name, as in {joint1: 10.0}",
    "list_type": "give a list, as in [a, b]",
}
"""What to do about faults of which pydantic says in Python's words what they are."""


def _blocks_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[type[BaseModel]]:
    """The blocks that may stand at a location, in which the chosen member of a union is named by its tag."""
    blocks = [model]
    for part in loc:
        fields = [block.model_fields[str(part)] for block in blocks if part in block.model_fields]
        below = [inner for field in fields for inner in _blocks(field.annotation)]
        blocks = below or [block for block in blocks if part in _tags(block)] or blocks
    return blocks


def _blocks(annotation: Any) -> list[type[BaseModel]]:
    """Every block inside an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [block for inner in typing.get_args(annotation) for block in _blocks(inner)]


def _tags(block: type[BaseModel]) -> set[str]:
    """Names by which a block is chosen from a union: its literal `type` or `name`."""
    fields = [block.model_fields[key] for key in ("type", "name") if key in block.model_fields]
    return {tag for field in fields for tag in typing.get_args(field.annotation) if isinstance(tag, str)}
