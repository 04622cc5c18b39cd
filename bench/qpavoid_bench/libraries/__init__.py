"""Other libraries beside qpavoid: each in an environment and a process of its own, behind one adapter each.

The adapters are in `foreign`, which is run by the libraries' own interpreters. Both `qpavoid bench tick` and the arena
use them; each library is used as its documentation and examples use it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from qpavoid_bench.libraries import environments


@dataclass(frozen=True)
class Library:
    """A library, its environment and its settings."""

    name: str
    description: str
    """Description in a line."""
    requirements: tuple[str, ...]
    """What pip installs."""
    settings: str
    """What it is given."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Values that its adapter takes from here."""
    environment: str = ""
    """Name of its environment, and of its adapter; its own name if empty."""

    distance_tolerance: float = 1e-6
    """How far its distances of spheres and capsules may be off, which most libraries compute in closed form [m]."""

    @property
    def module(self) -> str:
        """Return the module of its adapter."""
        return f"{self.environment or self.name}_adapter"

    @property
    def packages(self) -> tuple[str, ...]:
        """Return the names of the packages that are asked for."""
        return tuple(requirement.partition("=")[0] for requirement in self.requirements)

    @property
    def is_installed(self) -> bool:
        """Return whether its environment is there."""
        return environments.is_made(self.environment or self.name, self.requirements)

    def interpreter(self) -> Path:
        """Return the interpreter of its environment, which is made if need be.

        Raises:
            ConfigError: it cannot be made.
        """
        return environments.interpreter(self.environment or self.name, self.requirements)


_EMBODIK = (
    "solve_position_step with its examples' runtime policy; SCALE pose tasks, gain 1/dt; collision constraint of all "
    "pairs, min_distance = d1, 5 rows; obstacles are fixed links"
)

LIBRARIES = {
    library.name: library
    for library in (
        Library(
            "pink",
            "Pink, with its barrier between collision bodies",
            ("pin-pink==4.4.0", "daqp==0.11.0"),
            "FrameTask (cost 50, gain 1); SelfCollisionBarrier (20 nearest pairs, d_min = d1, gain 20, safe "
            "displacement gain 1); position, velocity and, where the robot has them, acceleration limits; solver daqp; "
            "obstacles are bodies of the collision model",
            {"cost": 50.0, "n_collision_pairs": 20, "gain": 20.0, "safe_displacement_gain": 1.0},
        ),
        Library(
            "mink",
            "mink, with its limit on collisions",
            ("mink==1.3.0", "mujoco==4.0.0", "daqp==0.11.0"),
            "FrameTask (gain 1); CollisionAvoidanceLimit (minimum distance d1, detection distance d2, gain 0.85, the "
            "pairs given, not filtered); ConfigurationLimit (gain 0.95), VelocityLimit; solver daqp",
        ),
        Library(
            "placo",
            "placo, with its constraint on self-collisions",
            ("placo==0.10.2",),
            "soft frame tasks; avoid_self_collisions constraint (hard, margin d1, trigger d2); joint and velocity "
            "limits; fixed robots through mask_fbase; obstacles are bodies of the collision model",
        ),
        Library(
            "roboplan",
            "OInK of roboplan, with its barrier on self-collisions",
            ("roboplan==0.7.0",),
            "FrameTask (gain 1, lm_damping 0.01); SelfCollisionBarrier (20 pairs, d_min = d1, d_max = d2, gain 1, safe "
            "displacement gain 0.01), then enforceBarriers; PositionLimit, VelocityLimit; regularization 1e-6",
            {"n_collision_pairs": 20},
        ),
        Library(
            "embodik",
            "embodik, with its collision constraint",
            ("embodik==0.23.2",),
            _EMBODIK,
            {"max_constraints": 5, "call": "solve_position_step"},
        ),
        Library(
            "drake",
            "Drake's DifferentialInverseKinematicsSystem, with its collision constraint",
            ("drake==1.51.1",),
            "LeastSquaresCost (weight 100), JointCenteringCost; CollisionConstraint (safety distance d1, influence "
            "distance d2); JointVelocityLimitConstraint; K_VX 1; its distances are iterated on, to 0.1 mm",
            distance_tolerance=1e-4,
        ),
    )
}
"""In the order of the reports."""
