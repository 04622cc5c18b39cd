"""Whether there is room for an obstacle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.model.robot import Robot
from qpavoid.problem import Array

Placed = tuple[Any, Any]
"""A coal shape and its place."""


def bodies_at(robot: Robot, q: Array) -> list[tuple[int, Any, Any]]:
    """Joint, shape and place of each of a robot's bodies at q (nq,)."""
    data = robot.bodies.createData()
    pin.updateGeometryPlacements(robot.model, robot.model.createData(), robot.bodies, data, q)
    return [
        (body.parentJoint, body.geometry, coal.Transform3s(place.rotation, place.translation))
        for body, place in zip(robot.bodies.geometryObjects, data.oMg, strict=True)
    ]


def placed(geometry: Any) -> Placed:
    """A geometry in the frame that it is fixed to."""
    place = geometry.placement
    return geometry.geometry, coal.Transform3s(place.rotation, place.translation)


def gap(shape: Any, here: Any, others: Sequence[Placed]) -> float:
    """Smallest distance of a shape from others in their places [m], negative inside; inf from none."""
    request = coal.DistanceRequest()
    distances = (coal.distance(shape, here, *other, request, coal.DistanceResult()) for other in others)
    return min(distances, default=np.inf)
