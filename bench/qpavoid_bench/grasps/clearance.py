"""How clear a robot's bodies are of obstacles, and of each other, at the start and at the goal of a problem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qpavoid.control.distances import DistanceQuery
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.problem import Array
from qpavoid_bench.grasps.problems import Problem

REQUIRED = 0.002
"""Distance from which a pair counts as clear [m]: goals of the set are within 3 to 10 mm of objects by the meshes."""


@dataclass(frozen=True)
class Clearance:
    """Distances at one configuration."""

    distance: float
    """Of the pair that has least to spare, negative in penetration [m]."""
    pair: tuple[str, str]
    """Its bodies."""
    is_clear: bool
    """Whether all pairs are as far apart as required; of the robot's own pairs that are nearer by design, as far as
    their own safety distance says."""


def measure(problem: Problem, required: float = REQUIRED) -> tuple[Clearance, Clearance]:
    """Measure the clearance of start and goal.

    Args:
        problem: robot, obstacles and both configurations.
        required: distance from which a pair counts as clear [m].
    """
    scene = problem.scene
    query, kinematics = DistanceQuery(scene), ForwardKinematics(scene.robot.model)
    needed = required - scene.distance_allowance(required)

    def at(q: Array) -> Clearance:
        kinematics.compute(q)
        query.compute(kinematics.joint_poses, np.inf)
        distances = query.distances_of(np.arange(len(scene.pairs)))
        worst = int(np.argmin(distances - needed))
        return Clearance(float(distances[worst]), scene.pair_names[worst], bool(np.all(distances >= needed)))

    return at(problem.q_start), at(problem.q_goal)
