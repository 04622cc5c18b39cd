"""What all parts of a controller share: robot, scene, limits and the blocks of the scenario."""

from __future__ import annotations

from dataclasses import dataclass, field

from qpavoid.budget import UNLIMITED, Budget
from qpavoid.config import Avoidance, Limits, Progress, Sensing
from qpavoid.control.dynamics import RobotDynamics
from qpavoid.errors import ConfigError
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
    dynamics: RobotDynamics | None = None
    """Dynamics of the robot; None at velocity level."""

    @property
    def safety_distance(self) -> float:
        """Between surfaces [m]."""
        return self.avoidance.d1 - self.avoidance.offset

    @property
    def influence_distance(self) -> float:
        """Between surfaces, below which a pair gets a row [m]."""
        return float(self.avoidance.d2 - self.avoidance.offset)


def make_budget(seconds: float | Budget | None) -> Budget:
    """Return a budget [s] of control steps; a given one as it is, and for None one without a limit.

    Raises:
        ConfigError: it is not positive.
    """
    if isinstance(seconds, Budget):
        return seconds
    if seconds is None:
        return UNLIMITED
    if not seconds > 0.0:
        raise ConfigError(f"budget: {seconds} s, expected more than 0; it is in seconds")
    return Budget(seconds)
