"""Cases of a family: drawn, assembled, and kept once their claims are proved."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.config.loading import validate
from qpavoid.errors import ConfigError, QpavoidError
from qpavoid_bench.arena.case import Case, Sensor
from qpavoid_bench.arena.families.family import Family
from qpavoid_bench.arena.families.parameters import Draw, Redraw
from qpavoid_bench.arena.families.solvable import solved_by
from qpavoid_bench.arena.world import World, build_world, load_robot

MAX_DRAWS = 100
"""Largest number of draws of a seed before the family is refused."""
_DIGITS = 9
"""Decimals that numbers of a scenario keep: machines round differently in the last ones."""


def make_case(family: Family, seed: int) -> Case:
    """Make the case of a seed: the same at every call, in every process.

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
    causes: list[str] = []
    for number in range(MAX_DRAWS):
        draw = Draw(family.config.parameters, seed, number, family.in_template)
        try:
            scenario = _scenario(family, template, draw, seed)
            world, config = build_world(scenario), family.config
            random = np.random.default_rng([seed, number])
            how = "it starts below d1, and is to get out" if not config.starts_clear else ""
            if config.starts_clear:
                provable = config.reachable if config.proved else None
                how = solved_by(scenario, world, provable, random, config.static)
        except Redraw as reason:
            causes.append(str(reason))
            continue
        sensor = validate(_rounded(family.fill(config.sensor, draw)), Sensor, family.path)
        if config.deviations is not None:
            scenario = _with_uncertainty(scenario, world, sensor, config.deviations)
        return Case(family.name, seed, scenario, sensor, config.reachable, how)
    worst = max(set(causes), key=causes.count)
    raise ConfigError(
        f"{family.path}: seed {seed}: {MAX_DRAWS} draws and no case, most often: {worst}; widen or shift the ranges"
    )


def _scenario(family: Family, template: dict[str, Any], draw: Draw, seed: int) -> ScenarioConfig:
    """Assemble the scenario of a draw from template and generator."""
    template_fields = family.fill(template, draw)
    fields = {"title": f"{family.config.title}, seed {seed}", "tags": [family.name], **template_fields}
    if family.generator is not None:
        generated = _generate(family, template_fields, draw)
        duplicates = sorted(generated.keys() & template_fields.keys() - {"q0"})
        if duplicates:
            raise ConfigError(f"{family.path}: scenario.{duplicates[0]}: the generator gives it, too; leave one out")
        fields.update(generated)
        if "q0" in generated and isinstance(template_fields.get("q0"), dict):
            fields["q0"] = {**template_fields["q0"], **generated["q0"]}
    return validate(_rounded(fields), ScenarioConfig, family.path).with_source(family.path)


def _with_uncertainty(scenario: ScenarioConfig, world: World, sensor: Sensor, deviations: float) -> ScenarioConfig:
    """Return a scenario whose obstacles have an `uncertainty`: of noise, and of what they move by within the delay."""
    times, motions = np.linspace(0.0, scenario.duration, 50), {o.name: o.motion for o in world.scene.obstacles}
    obstacles = []
    for obstacle in scenario.obstacles:
        speeds = [np.linalg.norm(motions[obstacle.name].sample(t).linear) for t in times.tolist()]
        uncertainty = _rounded(deviations * sensor.position_noise + sensor.delay * max(speeds))
        obstacles.append(obstacle.model_copy(update={"uncertainty": uncertainty}))
    return scenario.model_copy(update={"obstacles": obstacles})


def _generate(family: Family, template_fields: dict[str, Any], draw: Draw) -> dict[str, Any]:
    """Run the generator of a family and check what it drew."""
    assert family.generator is not None
    where = f"{family.path}: generator {family.config.generator}"
    fields = template_fields.get("q0", {}), template_fields.get("lock", [])
    robot, q0 = load_robot(template_fields["robot"], *fields, family.path)
    try:
        generated = dict(family.generator(draw, replace(robot, home=q0)))
    except Redraw:
        raise
    except QpavoidError as error:
        raise type(error)(f"{where}: {error}") from error
    except Exception as error:  # whatever a reader's function does
        raise ConfigError(f"{where}: {type(error).__name__}: {error}") from error
    unused_names = sorted(family.config.parameters.keys() - draw.names_drawn - family.in_template)
    if unused_names:
        raise ConfigError(f"{where}: never draws {unused_names[0]!r}; leave it out of `parameters`")
    return generated


def _rounded(value: Any) -> Any:
    """Return a document with lists for arrays, and numbers of few decimals."""
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_rounded(inner) for inner in value]
    if isinstance(value, float | np.floating):
        return round(float(value), _DIGITS) + 0.0
    return int(value) if isinstance(value, np.integer) else value
