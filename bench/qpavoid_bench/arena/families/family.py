"""Families of scenarios: one YAML file with parameters, their ranges and a template."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from qpavoid.config.base import Block
from qpavoid.config.files import read_text
from qpavoid.config.loading import read_config, read_mapping
from qpavoid.config.shipped import find_robot, find_shipped, shipped_names
from qpavoid.errors import ConfigError, UnknownName, located, nearest
from qpavoid.model.robot import Robot
from qpavoid.solvers.python_file import MAX_FILE_SIZE, load_attribute
from qpavoid_bench.arena.families import adversarial, moving, statics, teleoperation, two_arms
from qpavoid_bench.arena.families.parameters import Draw, Parameter

Generator = Callable[[Draw, Robot], Mapping[str, Any]]
"""Function from draws and the robot to fields of a scenario; the robot's locked joints are gone, its home is the
setup's q0."""

GENERATORS: dict[str, Generator] = {
    "sphere_field": statics.sphere_field,
    "shelf": statics.shelf,
    "box": statics.box,
    "opening": statics.opening,
    "narrow_gap": statics.narrow_gap,
    "unreachable": statics.unreachable,
    "crossing_arms": two_arms.crossing_arms,
    "passing": two_arms.passing,
    **{name: partial(moving.movers, motion) for name, motion in moving.MOTIONS.items()},
    "random_walk": partial(moving.movers, moving.wander),
    "adversarial": adversarial.adversarial,
    "jumps": teleoperation.jumps,
    "leaving_reach": teleoperation.leaving_reach,
    "singular": teleoperation.singular,
    "behind": teleoperation.behind,
    "edge": teleoperation.edge,
    "bad_start": teleoperation.bad_start,
}
"""Generators that ship."""

_NAME = re.compile(r"\$(\w+)")
_ROBOT_FIELDS = ("robot", "q0", "lock")
"""Fields of a scenario that belong to its robot; they stand in `robots`."""


class FamilyConfig(Block):
    """A file of tasks/families/."""

    title: Annotated[str, Field(min_length=1)]
    """Title in a few words."""
    about: Annotated[str, Field(min_length=1)]
    """Difficulty that it poses to a controller."""
    robots: Annotated[list[str | dict[str, Any]], Field(min_length=1)]
    """Robots, one a seed in turn: a setup or a robot by name, or fields of a scenario, `robot` among them."""
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    """Parameters and their ranges."""
    scenario: dict[str, Any] = Field(default_factory=dict)
    """Fields of a scenario, in which "$name" stands for the value of a parameter."""
    generator: str | None = None
    """Function that computes the missing fields: one that ships, or `file.py:function` beside this file."""
    sensor: dict[str, Any] = Field(default_factory=dict)
    """Delay and noise of measured obstacle states: fields of `qpavoid_bench.arena.case.Sensor`, "$name" as above."""
    deviations: Annotated[float, Field(ge=0)] | None = None
    """Number of standard deviations of a position that obstacles are given as `uncertainty`, beside what they move by
    within the delay; left out: they are given none [-]."""
    reachable: bool = True
    """Whether the goals can be reached; it is checked, whichever it is."""
    proved: bool = True
    """Whether a solution is proved to exist; where not, each contact is judged avoidable or not (`arena.verdict`)."""
    static: bool = False
    """Whether a robot that stays where it starts touches nothing, which is proved in place of a way to the goals."""
    starts_clear: bool = True
    """Whether everything is farther apart than d1 at the start."""

    @model_validator(mode="after")
    def _check_robots(self) -> FamilyConfig:
        for index, entry in enumerate(self.robots):
            if isinstance(entry, dict) and not isinstance(entry.get("robot"), str):
                raise ValueError(f"robots.{index}: needs a field `robot`")
        misplaced = [key for key in _ROBOT_FIELDS if key in self.scenario]
        if misplaced:
            raise ValueError(f"scenario: `{misplaced[0]}` belongs into `robots`, which may hold such fields")
        return self


@dataclass(frozen=True)
class Family:
    """A family that was read and checked."""

    name: str
    path: Path
    config: FamilyConfig
    templates: tuple[dict[str, Any], ...]
    """Fields of a scenario for each robot: of its setup, of `scenario`, of its own entry; later ones count."""
    generator: Generator | None
    in_template: frozenset[str]
    """Parameters that occur in a template, or in `sensor`."""

    def fill(self, template: Any, draw: Draw) -> Any:
        """Return a template with values in the places of "$name"."""
        if isinstance(template, dict):
            return {key: self.fill(value, draw) for key, value in template.items()}
        if isinstance(template, list):
            return [self.fill(value, draw) for value in template]
        if isinstance(template, str) and (match := _NAME.fullmatch(template)):
            return draw(match[1])
        return template


def load_family(name_or_path: str | Path) -> Family:
    """Read a family.

    Args:
        name_or_path: shipped name or path of a YAML file. A generator that it names in a Python file is run.

    Raises:
        ConfigError, UnknownName: naming file, field and remedy.
    """
    path = find_shipped("family", name_or_path)
    config = read_config(path, FamilyConfig)
    layers = {"scenario": config.scenario, "robots": config.robots, "sensor": config.sensor}
    locations = {name: location for key, layer in layers.items() for name, location in _names(layer, key)}
    for name, location in locations.items():
        if name not in config.parameters:
            raise UnknownName(f"{path}: {location}: unknown parameter '${name}'{nearest(name, config.parameters)}")
    unused_names = sorted(config.parameters.keys() - locations)
    if unused_names and config.generator is None:
        raise ConfigError(
            f"{path}: parameters.{unused_names[0]}: stands nowhere as ${unused_names[0]}; use it, or leave it out"
        )
    return Family(
        name=path.stem,
        path=path,
        config=config,
        templates=tuple(_template(entry, config, path, f"{path}: robots.{i}") for i, entry in enumerate(config.robots)),
        generator=None if config.generator is None else _generator(config.generator, path),
        in_template=frozenset(locations),
    )


def _names(template: Any, location: str) -> Iterator[tuple[str, str]]:
    """Yield parameters in a template, and their places in it."""
    if isinstance(template, dict | list):
        for key, value in template.items() if isinstance(template, dict) else enumerate(template):
            yield from _names(value, f"{location}.{key}")
    elif isinstance(template, str) and template.startswith("$"):
        yield template[1:], location


def _template(entry: str | dict[str, Any], config: FamilyConfig, path: Path, location: str) -> dict[str, Any]:
    """Return fields of a scenario for a robot."""
    if isinstance(entry, str) and entry in shipped_names("setup"):
        return {**read_mapping(find_shipped("setup", entry)), **config.scenario}
    fields = {"robot": entry} if isinstance(entry, str) else entry
    try:
        if not fields["robot"].startswith("$"):
            find_robot(fields["robot"], path.parent)
    except UnknownName as error:
        raise UnknownName(f"{location}: {error}; or a setup: {', '.join(shipped_names('setup'))}") from None
    except ConfigError as error:
        raise ConfigError(f"{location}: {error}") from None
    return {**config.scenario, **fields}


def _generator(name: str, path: Path) -> Generator:
    """Return a generator by shipped name, or from a file."""
    file, colon, function = name.rpartition(":")
    if not colon:
        if name not in GENERATORS:
            own = "; or give your own as my_file.py:function"
            raise UnknownName(f"{path}: generator: unknown generator {name!r}{nearest(name, GENERATORS)}{own}")
        return GENERATORS[name]
    with located(f"{path}: generator"):
        generator: Generator = load_attribute(read_text(path.parent / file, MAX_FILE_SIZE), file, function)
    return generator
