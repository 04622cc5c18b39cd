"""A whole plan in one call: clearances that are tried in turn, goals, trees, shortcuts."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled, released
from qpavoid.kernels.planning import FINE, is_clear, pair_clearances
from qpavoid.kernels.planning_goals import FrameTargets, clear_goals
from qpavoid.kernels.planning_tree import connect, shorten, shortest_time
from qpavoid.problem import Array

DONE, NOT_ATTAINED, NO_CLEAR_GOAL, NO_PATH = range(4)
"""How a search ends; of several, the last one that applies."""
BACK_OFF = 1e-3
"""What a pair may lose of the distance that it begins or ends with, where that is less than it should have [m]."""
_ENOUGH = 0.1
"""Distance beyond what a goal needs at least up to which its distances are of interest [m]."""


@released
def search(
    x: Any,
    start: Array,
    goals: Array,
    targets: FrameTargets,
    near: Array,
    arrival: float,
    needs: Array,
    least: Array,
    first_nodes: int,
    max_nodes: int,
    max_checks: int,
    max_goals: int,
    tries: int,
    shortcuts: int,
    tolerance: float,
    seed: int,
) -> tuple[Array, int, int, int, int]:
    """Find a path from a start to one of some goals.

    Args:
        x: memory of the plan, see `PlanningArrays`.
        start: coordinates (n,), at time 0.
        goals: coordinates (g, n); none where targets are given.
        targets: where frames should be at the end; none where goals are given.
        near: coordinates (n,) next to which goals are looked for first.
        arrival: time of the goals [s]; 0 where obstacles rest.
        needs: distances that the pairs need (c, k), tried in turn [m].
        least: distance that pairs need next to a goal, if no goal has more (k,) [m].
        first_nodes: of the first trees, with each row of `needs`: a path with less clearance, if it is soon found, is
            better than a long search.
        max_nodes: of the last trees, with the last row.
        max_checks: of all configurations.
        max_goals: of targets.
        tries: searches for these.
        shortcuts: tried in place of parts of the path.
        tolerance: see `attain`.
        seed: of all draws.

    Returns:
        Nodes [coordinates, time] of the path (p, n + 1); row of `needs`; number of nodes of the last trees, and of
        goals; how it ended.
    """
    n, levels, is_timed, nodes, ending = len(start), len(needs), arrival > 0.0, 0, NOT_ATTAINED
    ends, counts = np.zeros((levels, max(max_goals, len(goals)), n + 1)), np.full(levels, -1)
    attained, searches, root = np.empty((tries, n)), np.zeros(2, np.intp), np.zeros(n + 1)
    root[:n] = start
    for attempt in range(levels + 1):
        level, size = min(attempt, levels - 1), max_nodes if attempt == levels else min(max_nodes, first_nodes)
        if x.checks[0] >= max_checks:
            break
        need = needs[level]
        if counts[level] < 0:
            if targets.rows > 0:
                some = clear_goals(x, targets, near, arrival, need, tolerance, max_goals, seed, attained, searches)
                if searches[1] == 0:
                    break
                counts[level] = len(some)
                ends[level, : len(some), :n] = some
                if len(some) == 0 and level == levels - 1:
                    counts[level] = _given_goals(x, attained[: searches[1]], arrival, need, least, ends[level])
            else:
                counts[level] = _given_goals(x, goals, arrival, need, least, ends[level])
            ending = max(ending, NO_CLEAR_GOAL)
            ends[level, :, n] = arrival
        if counts[level] == 0:
            continue
        ending = NO_PATH
        path, nodes = connect(x, root, ends[level, : counts[level]], need, is_timed, size, max_checks, seed)
        if len(path) > 0:
            path = shorten(x, path, need, is_timed, shortcuts, seed)
            for k in range(1, len(path)):
                if not is_timed:
                    path[k, n] = path[k - 1, n] + shortest_time(x, path[k - 1], path[k])
            return path, level, nodes, counts[level], DONE
    return np.empty((0, n + 1)), 0, nodes, counts.max(), ending


@compiled
def _given_goals(x: Any, goals: Array, t: float, need: Array, least: Array, ends: Array) -> int:
    """Write the goals that are clear; where none is, the first one that has what its pairs need at least.

    Its pairs then need no more than that, or than what they have there, less `BACK_OFF`.
    """
    count = 0
    for goal in goals:
        if is_clear(x, goal, t, need):
            ends[count, : len(goal)] = goal
            count += 1
    if count > 0:
        return count
    distances, limit = np.empty(len(need)), 0.0
    for k in range(len(need)):
        limit = max(limit, need[k] + _ENOUGH)
    for goal in goals:
        pair_clearances(x, goal, t, limit, distances)
        is_enough = True
        for k in range(len(need)):
            is_enough = is_enough and distances[k] >= min(need[k], least[k]) + FINE
        if is_enough:
            for k in range(len(need)):
                need[k] = min(need[k], max(distances[k] - BACK_OFF, least[k]))
            ends[0, : len(goal)] = goal
            return 1
    return 0
