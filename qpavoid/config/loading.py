"""Robot and scenario files: reading, `--set` overrides, and errors in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from qpavoid.config import ScenarioConfig, expand_solver
from qpavoid.config.explain import explain
from qpavoid.config.files import parse_yaml, read_text
from qpavoid.config.shipped import find_shipped
from qpavoid.config.solver import SolverConfig, SolverField
from qpavoid.errors import ConfigError

Config = TypeVar("Config", bound=BaseModel)
_LARGEST = 1_000_000
"""Size of a YAML file [bytes]; those that ship take 3000."""


def load_scenario(name_or_path: str | Path, overrides: Sequence[str] = (), solver: str | None = None) -> ScenarioConfig:
    """Read a scenario.

    Args:
        name_or_path: shipped name or path of a YAML file.
        overrides: `path=value` strings such as `avoidance.d2=0.30`; the value is YAML, `tasks.0.gain=3` indexes a
            list.
        solver: replaces the scenario's solver, as in `eq10` or `qp:proxqp`; settings of the file stay where the
            name is the same.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    path = find_shipped("scenario", name_or_path)
    return read_config(path, ScenarioConfig, overrides, solver).with_source(path)


def read_config(path: Path, model: type[Config], overrides: Sequence[str] = (), solver: str | None = None) -> Config:
    """Read a YAML file into `model`.

    Raises:
        ConfigError: unreadable file, bad YAML, unknown key (with the nearest valid one) or bad value.
    """
    data = read_mapping(path)
    if solver is not None:
        solver_fields(solver, f"solver {solver!r}: ")
        chosen_solver, settings = _solver_mapping(solver), _solver_mapping(data.get("solver"))
        data["solver"] = (
            {**settings, **chosen_solver} if settings.get("name") == chosen_solver["name"] else chosen_solver
        )
    for override in overrides:
        _set(data, override, path)
    return validate(data, model, path)


def validate(data: dict[str, Any], model: type[Config], path: Path) -> Config:
    """Validate the fields of a file as a configuration.

    Raises:
        ConfigError: unknown key (with the nearest valid one) or bad value.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error, model, data)}") from None


def solver_fields(value: Any, where: str = "") -> SolverConfig:
    """Validate what may stand in the field `solver` of a scenario: a short form, or a mapping.

    Raises:
        ConfigError: unknown name or key, or bad value; `where` comes before it.
    """
    fields = {"solver": dict(value) if isinstance(value, Mapping) else value}
    try:
        return SolverField.model_validate(fields).solver
    except ValidationError as error:
        raise ConfigError(f"{where}{explain(error, SolverField, fields)}") from None


def _solver_mapping(value: Any) -> dict[str, Any]:
    """Expand a solver's short form to a mapping."""
    expanded = expand_solver("qp" if value is None else value)
    return dict(expanded) if isinstance(expanded, dict) else {}


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the fields of a YAML file as they stand there.

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
    """Apply `a.b.0.c=value` in place.

    Missing mappings along the path are made, so that defaults can be set.
    """
    where, equals, text = override.partition("=")
    if not equals or not where:
        raise ConfigError(f"--set {override!r}: expected path=value, as in avoidance.d2=0.30")
    try:
        value = parse_yaml(text)
    except ValueError:
        raise ConfigError(f"--set {override!r}: {text!r} is not a YAML value") from None
    node: Any = data
    *inner, last = where.split(".")
    for depth, key in enumerate([*inner, last]):
        index: Any = key
        if isinstance(node, list):
            if not key.isdecimal() or len(key) > 9 or int(key) >= len(node):
                raise ConfigError(f"{path}: --set {where}: {key!r} is not an index below {len(node)}")
            index = int(key)
        elif not isinstance(node, dict):
            raise ConfigError(f"{path}: --set {where}: there is nothing below {'.'.join(inner[:depth])}")
        elif depth < len(inner) and not isinstance(node.get(key), dict | list):
            node[key] = _solver_mapping(node.get(key)) if key == "solver" else {}
        if depth == len(inner):
            node[index] = value
        else:
            node = node[index]
