"""Paths from the start of a problem to its goal, and how long it takes to plan them."""

from __future__ import annotations

from dataclasses import dataclass
from time import thread_time

from qpavoid import PlannerSettings, make_planner
from qpavoid_bench.grasps.clearance import REQUIRED
from qpavoid_bench.grasps.problems import Problem


@dataclass(frozen=True)
class Plan:
    """One plan to the goal configuration."""

    is_complete: bool
    """Whether there is a path."""
    time: float
    """Of the processor, for the plan alone: the scene is laid out before [s]."""
    clearance: float
    """Distance beyond the required one that all pairs have, but those that start or end nearer; NaN without [m]."""
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
    return Plan(bool(path), thread_time() - begin, path.clearance, str(path.reason or ""))
