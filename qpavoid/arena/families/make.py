"""Cases of a family: drawn, put together, and kept only once they are known to be what the family says."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid.arena.case import Case, Sensor
from qpavoid.arena.families.family import Family
from qpavoid.arena.families.parameters import Draw, Redraw
from qpavoid.arena.families.solvable import solved_by
from qpavoid.arena.world import world_of
from qpavoid.config import ScenarioConfig
from qpavoid.config.loading import validate
from qpavoid.errors import ConfigError, QpavoidError, located
from qpavoid.model.robot import Robot

MOST_DRAWS = 100
"""Draws of a seed that may turn out to be no case."""
_DIGITS = 9
"""Decimals that numbers of a scenario keep: machines round differently in the last ones."""


def make_case(family: Family, seed: int) -> Case:
    """The case of a seed: the same at every call, in every process.

    A draw that is no scenario, starts too near to something, or of which no solution is found (or, of a family whose
    goals are out of reach, no proof of that) is followed by another one.

    Args:
        family: as loaded.
        seed: 0 or more; it also picks the robot, `robots[seed % len(robots)]`.

    Raises:
        ConfigError, UnknownName: the family makes no scenario, has parameters that its generator never draws, or none
            of its draws is solvable.
    """
    if seed < 0:
        raise ConfigError(f"{family.path}: seed {seed}: give 0 or more")
    template = family.templates[seed % len(family.templates)]
    said: list[str] = []
    for number in range(MOST_DRAWS):
        draw = Draw(family.config.parameters, seed, number, family.in_template)
        try:
            scenario = _scenario(family, template, draw, seed)
            robot, q0 = _robot(family, scenario.robot, scenario.q0, scenario.lock)
            world = world_of(scenario, robot, q0)
            how = solved_by(scenario, world, family.config.reachable, np.random.default_rng([seed, number]))
        except Redraw as reason:
            said.append(str(reason))
            continue
        return Case(family.name, seed, scenario, _sensor(family, draw), family.config.reachable, how)
    worst = max(set(said), key=said.count)
    raise ConfigError(
        f"{family.path}: seed {seed}: {MOST_DRAWS} draws and no case, most often: {worst}; widen or shift the ranges"
    )


def _scenario(family: Family, template: dict[str, Any], draw: Draw, seed: int) -> ScenarioConfig:
    """The scenario of a draw: what the template says, and what the generator adds."""
    stated = family.filled(template, draw)
    fields = {"title": f"{family.config.title}, seed {seed}", "tags": [family.name], **stated}
    if family.generator is not None:
        made = _made(family, stated, draw)
        twice = sorted(made.keys() & stated.keys() - {"q0"})
        if twice:
            raise ConfigError(f"{family.path}: scenario.{twice[0]}: the generator gives it, too; leave one out")
        fields.update(made)
        if "q0" in made and isinstance(stated.get("q0"), dict):
            fields["q0"] = {**stated["q0"], **made["q0"]}
    return validate(_plain(fields), ScenarioConfig, family.path).with_source(family.path)


def _made(family: Family, stated: dict[str, Any], draw: Draw) -> dict[str, Any]:
    """What the generator says."""
    assert family.generator is not None
    where = f"{family.path}: generator {family.config.generator}"
    robot, q0 = _robot(family, stated["robot"], stated.get("q0", {}), stated.get("lock", []))
    try:
        made = dict(family.generator(draw, replace(robot, home=q0)))
    except Redraw:
        raise
    except QpavoidError as error:
        raise type(error)(f"{where}: {error}") from error
    except Exception as error:  # whatever a reader's function does
        raise ConfigError(f"{where}: {type(error).__name__}: {error}") from error
    unused = sorted(family.config.parameters.keys() - draw.drawn - family.in_template)
    if unused:
        raise ConfigError(f"{where}: never draws {unused[0]!r}; leave it out of `parameters`")
    return made


def _sensor(family: Family, draw: Draw) -> Sensor:
    return validate(_plain(family.filled(family.config.sensor, draw)), Sensor, family.path)


def _robot(family: Family, name: str, q0: Any, lock: list[str]) -> tuple[Robot, Any]:
    """A robot without its locked joints, and where it starts."""
    robot = _loaded(name, family.path.parent)
    return robot.lock(lock, robot.configuration(q0, f"{family.path}: q0"), f"{family.path}: lock")


@lru_cache(maxsize=16)
def _loaded(name: str, folder: Path) -> Robot:
    with located(f"{folder}: robots"):
        return Robot.load(name, folder)


def _plain(value: Any) -> Any:
    """The same of lists, and of numbers with few decimals."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(inner) for inner in value]
    if isinstance(value, float | np.floating):
        return round(float(value), _DIGITS) + 0.0
    return int(value) if isinstance(value, np.integer) else value
