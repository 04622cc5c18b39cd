"""Benchmark cases: a scenario, the sensor of its obstacles, and the proof of its solution."""

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
    """Delay and noise of the measured obstacle states; the checker uses the true ones."""

    delay: NonNegative = 0.0
    """Age of a measurement [s]."""
    position_noise: NonNegative = 0.0
    """Standard deviation of each coordinate of a position [m]."""
    velocity_noise: NonNegative = 0.0
    """Standard deviation of each coordinate of a linear velocity [m/s]."""

    @property
    def perfect(self) -> bool:
        """Return True if there is neither delay nor noise."""
        return not (self.delay or self.position_noise or self.velocity_noise)


@dataclass(frozen=True)
class Case:
    """One scenario of a family."""

    family: str
    seed: int
    scenario: ScenarioConfig
    """Scenario without a solver of its own: entrants bring theirs."""
    sensor: Sensor
    reachable: bool
    """Whether the goals can be reached; where not, a run succeeds that stays clear and comes to rest."""
    solved_by: str
    """Check by which a solution is known to exist, and its result, in words."""

    @property
    def key(self) -> str:
        """Return a digest of all that makes the run, wherever the family's file lies."""
        return hashlib.sha256(self._to_text().encode()).hexdigest()[:16]

    def to_json(self) -> str:
        """Return the case as JSON text."""
        return self._to_text(source=str(self.scenario.source))

    def _to_text(self, **extra_fields: str) -> str:
        """Return the case as JSON text with sorted keys, and further fields."""
        fields = {
            **extra_fields,
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
        """Read a case from the text that `to_json` wrote."""
        fields: dict[str, Any] = json.loads(text)
        source = Path(fields.pop("source"))
        scenario = ScenarioConfig.model_validate(fields.pop("scenario")).with_source(source)
        return cls(scenario=scenario, sensor=Sensor.model_validate(fields.pop("sensor")), **fields)


class SensorModel:
    """Measurements of a case's obstacles, step by step; the same for every entrant."""

    def __init__(self, case: Case, obstacles: tuple[Obstacle, ...]) -> None:
        """Seed the noise with the seed of the case."""
        self._sensor, self._obstacles = case.sensor, obstacles
        self._random = np.random.default_rng([case.seed, 1])

    def measure(self, t: float) -> dict[str, Sample]:
        """Return measured states of the obstacles at t [s], by name.

        Static obstacles that are measured exactly are left out.
        """
        sensor, measured = self._sensor, {}
        for obstacle in self._obstacles:
            if sensor.perfect and not obstacle.moves:
                continue
            sample = obstacle.motion.sample(max(t - sensor.delay, 0.0))
            if not sensor.perfect:
                noise = self._random.normal(size=(2, 3))
                linear = sample.linear + sensor.velocity_noise * noise[1] if obstacle.moves else sample.linear
                sample = sample._replace(position=sample.position + sensor.position_noise * noise[0], linear=linear)
            measured[obstacle.name] = sample
        return measured
