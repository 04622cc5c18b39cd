"""Free space for an obstacle: distances of a shape from bodies and obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.model.robot import Robot
from qpavoid.problem import Array

PlacedShape = tuple[Any, Any]
"""A coal shape and its placement."""


def placed_bodies(robot: Robot, q: Array) -> list[tuple[int, Any, Any]]:
    """Return joint, shape and placement of each body of a robot at q (nq,)."""
    data = robot.bodies.createData()
    pin.updateGeometryPlacements(robot.model, robot.model.createData(), robot.bodies, data, q)
    return [
        (body.parentJoint, body.geometry, coal.Transform3s(place.rotation, place.translation))
        for body, place in zip(robot.bodies.geometryObjects, data.oMg, strict=True)
    ]


def min_distance(shape: Any, placement: Any, other_shapes: Sequence[PlacedShape]) -> float:
    """Return the smallest distance of a shape from others [m]; negative inside, inf from none."""
    request = coal.DistanceRequest()
    distances = (coal.distance(shape, placement, *other, request, coal.DistanceResult()) for other in other_shapes)
    return min(distances, default=np.inf)
