"""Shapes of obstacles and of bodies given by hand."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from qpavoid.config.base import Block, Positive


class Sphere(Block):
    """Ball about the origin."""

    type: Literal["sphere"] = "sphere"
    radius: Positive
    """Radius [m]."""


class Capsule(Block):
    """Segment along z, centred on the origin, swept by a ball."""

    type: Literal["capsule"] = "capsule"
    radius: Positive
    """Radius [m]."""
    length: Positive
    """Length of the axis between the centres of the two caps [m]."""


class Box(Block):
    """Cuboid centred on the origin."""

    type: Literal["box"] = "box"
    size: tuple[Positive, Positive, Positive]
    """Full side lengths along x, y, z [m]."""


class Cylinder(Block):
    """Cylinder along z, centred on the origin."""

    type: Literal["cylinder"] = "cylinder"
    radius: Positive
    """Radius [m]."""
    length: Positive
    """Height along z [m]."""


Shape = Annotated[Sphere | Capsule | Box | Cylinder, Field(discriminator="type")]
