"""What all parts of a controller share: robot, scene, limits and the blocks of the scenario."""

from __future__ import annotations

from dataclasses import dataclass, field

from qpavoid.budget import UNLIMITED, Budget
from qpavoid.config import Avoidance, Limits, Progress, Sensing
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """Settings of one controller."""

    scene: Scene
    """Robot and obstacles."""
    bounds: JointBounds
    """Limits of the joints that may be used."""
    avoidance: Avoidance
    limits: Limits
    dt: float
    """Control period [s]."""
    latency: float = 0.0
    """Time after which the actuators follow a command [s]."""
    sensing: Sensing = field(default_factory=Sensing)
    progress: Progress = field(default_factory=Progress)
    budget: Budget = UNLIMITED

    @property
    def safety_distance(self) -> float:
        """Between surfaces [m]."""
        return self.avoidance.d1 - self.avoidance.offset

    @property
    def influence_distance(self) -> float:
        """Between surfaces, below which a pair gets a row [m]."""
        return float(self.avoidance.d2 - self.avoidance.offset)
