"""One scenario of the arena: what is run, by what the obstacles are seen, and what is known of its solution."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qpavoid.config import ScenarioConfig
from qpavoid.config.base import Block, NonNegative
from qpavoid.model.scene import Obstacle
from qpavoid.model.trajectory import Sample


class Sensor(Block):
    """How obstacles are seen: late, and not quite where they are. The referee knows where they really are."""

    delay: NonNegative = 0.0
    """Age of what is seen [s]."""
    position_noise: NonNegative = 0.0
    """Standard deviation of each coordinate of a position [m]."""
    velocity_noise: NonNegative = 0.0
    """Standard deviation of each coordinate of a linear velocity [m/s]."""

    @property
    def perfect(self) -> bool:
        """Whether everything is seen as it is."""
        return not (self.delay or self.position_noise or self.velocity_noise)


@dataclass(frozen=True)
class Case:
    """One scenario of a family."""

    family: str
    seed: int
    scenario: ScenarioConfig
    """Without a solver of its own: entrants bring theirs."""
    sensor: Sensor
    reachable: bool
    """Whether the goals can be reached; where not, a run succeeds that stays clear and comes to rest."""
    solved_by: str
    """How it is known that a solution exists, in words: by which check, with what result."""

    @property
    def key(self) -> str:
        """Digest of all that makes the run, wherever the family's file lies."""
        return hashlib.sha256(self._text().encode()).hexdigest()[:16]

    def to_json(self) -> str:
        """The same as text."""
        return self._text(source=str(self.scenario.source))

    def _text(self, **more: str) -> str:
        fields = {
            **more,
            "family": self.family,
            "seed": self.seed,
            "scenario": self.scenario.model_dump(mode="json"),
            "sensor": self.sensor.model_dump(mode="json"),
            "reachable": self.reachable,
            "solved_by": self.solved_by,
        }
        return json.dumps(fields, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Case:
        """The case that `to_json` wrote."""
        fields: dict[str, Any] = json.loads(text)
        source = Path(fields.pop("source"))
        scenario = ScenarioConfig.model_validate(fields.pop("scenario")).with_source(source)
        return cls(scenario=scenario, sensor=Sensor.model_validate(fields.pop("sensor")), **fields)


class Sight:
    """What a sensor tells of the obstacles of a case, tick by tick; the same for every entrant."""

    def __init__(self, case: Case, obstacles: tuple[Obstacle, ...]) -> None:
        """Draws noise from the seed of the case."""
        self._sensor, self._obstacles = case.sensor, obstacles
        self._random = np.random.default_rng([case.seed, 1])

    def look(self, t: float) -> dict[str, Sample]:
        """Where obstacles seem to be at t [s], and how they seem to move; none of those that rest in plain sight."""
        sensor, seen = self._sensor, {}
        for obstacle in self._obstacles:
            if sensor.perfect and not obstacle.moves:
                continue
            sample = obstacle.motion.sample(max(t - sensor.delay, 0.0))
            if not sensor.perfect:
                noise = self._random.normal(size=(2, 3))
                linear = sample.linear + sensor.velocity_noise * noise[1] if obstacle.moves else sample.linear
                sample = sample._replace(position=sample.position + sensor.position_noise * noise[0], linear=linear)
            seen[obstacle.name] = sample
        return seen
