"""What all checks of a command share: robot, scene, limits and the blocks of the scenario."""

from __future__ import annotations

from dataclasses import dataclass

from qpavoid.config import Avoidance, Limits, Progress
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """Settings that the checks of one controller share."""

    scene: Scene
    """Robot and obstacles."""
    bounds: JointBounds
    """Limits of the joints that may be used."""
    avoidance: Avoidance
    limits: Limits
    progress: Progress
    dt: float
    """Control period [s]."""

    @property
    def safety_distance(self) -> float:
        """Between surfaces [m]."""
        return self.avoidance.safety_distance - self.avoidance.offset
