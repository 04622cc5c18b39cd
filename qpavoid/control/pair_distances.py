"""Distances of all pairs of a scene, near or not, by name: for programs and people between control steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.scene import PARKING_DISTANCE, Scene
from qpavoid.problem import Array


class PairDistance(NamedTuple):
    """Distance of one pair of bodies, with its witness points."""

    bodies: tuple[str, str]
    """Names of the two, in the order of the scene's pairs."""
    distance: float
    """Signed distance between their surfaces [m], negative in penetration."""
    normal: Array
    """(3,) unit normal from the first body to the second one, world axes."""
    point_a: Array
    """(3,) witness point on the first body, world [m]."""
    point_b: Array
    """(3,) witness point on the second body, world [m]."""


def pair_distances(
    scene: Scene, query: DistanceQuery, obstacles: ObstacleStates, q: Array, within: float
) -> list[PairDistance]:
    """Compute the distances of all pairs up to `within` [m], the nearest first; see `Controller.pair_distances`."""
    kinematics = ForwardKinematics(scene.robot.model)
    kinematics.compute(q)
    query.place(obstacles)
    query.compute(kinematics.joint_poses, min(within, 0.5 * PARKING_DISTANCE))
    results, names = query.arrays.results, scene.pair_names
    near = sorted((float(results[i, 0]), i) for i in query.pairs.tolist())
    return [
        PairDistance(names[i], d, *np.split(results[i, 1:].copy(), 3))
        for d, i in near
        if d <= min(within, 0.5 * PARKING_DISTANCE)
    ]
