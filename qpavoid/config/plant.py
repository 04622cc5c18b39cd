"""What a robot that is simulated with its dynamics differs in from the model that its controller has."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from qpavoid.config.base import Block, NonNegative, Positive, Vec3


class Push(Block):
    """A force on a frame of the robot for a while."""

    frame: str
    """Frame at whose origin it acts."""
    force: Vec3
    """The force, world axes [N]."""
    start: NonNegative
    """When it begins [s]."""
    duration: Positive = 0.1
    """How long it acts [s]."""


class Payload(Block):
    """A mass at a frame of the robot that the controller does not know."""

    frame: str
    """Frame that holds it."""
    mass: Positive
    """Its mass [kg]."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Its centre in the frame [m]; it is a sphere of 30 mm."""


class PlantSettings(Block):
    """A robot with torque motors in MuJoCo: friction, delay, noise and masses that its controller does not know."""

    armature: NonNegative | None = None
    """Inertia of each motor, as the joint feels it [kg m² or kg]; left out: that of the robot's model."""
    friction: NonNegative = 0.0
    """Dry friction of each joint [Nm or N]."""
    damping: NonNegative = 0.0
    """Viscous friction of each joint [Nms/rad or Ns/m]."""
    mass_scale: Positive = 1.0
    """Factor on masses, inertias, armature and friction, over those of the model [-]."""
    payload: Payload | None = None
    delay: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Time after which motors follow a command [s]."""
    position_noise: NonNegative = 0.0
    """Standard deviation of each measured coordinate [rad or m]."""
    velocity_noise: NonNegative = 0.0
    """Standard deviation of each measured velocity [rad/s or m/s]."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the noise [-]."""
    floor_friction: NonNegative = 0.7
    """Friction coefficient between contact points and floor [-]."""
    floor_height: float | None = None
    """Height of the floor [m]; left out: that of the lowest contact point at the start."""
    pushes: list[Push] = []
