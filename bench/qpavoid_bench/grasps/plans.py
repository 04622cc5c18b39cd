"""Paths from the start of a problem to its goal, and how long it takes to plan them."""

from __future__ import annotations

from dataclasses import dataclass
from time import thread_time

import coal
import numpy as np
import pinocchio as pin

from qpavoid import Path, PlannerSettings, make_planner
from qpavoid.problem import Array
from qpavoid_bench.grasps.clearance import REQUIRED
from qpavoid_bench.grasps.problems import Problem

SAMPLES = 100
"""Configurations of a path, evenly in time, at which coal computes all distances."""


@dataclass(frozen=True)
class Plan:
    """One plan to the goal configuration."""

    is_complete: bool
    """Whether there is a path."""
    time: float
    """Of the processor, for the plan alone: the scene is laid out before [s]."""
    clearance: float
    """Distance beyond the required one that all pairs have, but those that start or end nearer; NaN without [m]."""
    by_coal: float
    """The least of all distances along it beyond the required ones, computed by coal alone; NaN without [m]."""
    reason: str
    """Why there is none."""


def plan(problem: Problem, required: float = REQUIRED) -> Plan:
    """Plan a path from the start of a problem to its goal.

    Args:
        problem: robot, obstacles and both configurations.
        required: distance that every pair keeps [m].
    """
    planner = make_planner(problem.scene, PlannerSettings(safety_distance=required))
    begin = thread_time()
    path = planner.plan(problem.q_start, problem.q_goal)
    time = thread_time() - begin
    return Plan(bool(path), time, path.clearance, _least_by_coal(problem, path, required), str(path.reason or ""))


def _least_by_coal(problem: Problem, path: Path, required: float) -> float:
    """Return the least distance along a path beyond the required one [m], by coal, of pairs that a joint moves."""
    if not path:
        return np.nan
    scene, model = problem.scene, problem.robot.model
    pairs = np.flatnonzero(np.any(scene.support != 0.0, axis=1)).tolist()
    needed = required - scene.distance_allowance(required)
    data, placed, bodies = model.createData(), scene.geometry.createData(), scene.geometry.geometryObjects
    request, result, least = coal.DistanceRequest(), coal.DistanceResult(), np.inf
    for t in np.linspace(0.0, path.duration, SAMPLES):
        q = pin.interpolate(model, *_around(path, float(t)))
        pin.updateGeometryPlacements(model, data, scene.geometry, placed, q)
        places = [coal.Transform3s(pose.rotation, pose.translation) for pose in placed.oMg]
        for pair in pairs:
            i, j = scene.pairs[pair].tolist()
            result.clear()
            distance = coal.distance(bodies[i].geometry, places[i], bodies[j].geometry, places[j], request, result)
            least = min(least, distance - needed[pair])
    return float(least)


def _around(path: Path, t: float) -> tuple[Array, Array, float]:
    """Return the configurations of a path before and after a time, and the fraction between them."""
    k = min(max(int(np.searchsorted(path.t, t, side="right")) - 1, 0), len(path.t) - 2)
    return path.q[k], path.q[k + 1], min((t - path.t[k]) / (path.t[k + 1] - path.t[k]), 1.0)
