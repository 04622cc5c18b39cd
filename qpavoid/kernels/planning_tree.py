"""RRT-Connect and shortcuts: motions between a start and several goals that are clear all along.

Two trees grow towards each other, of the start and of all goals (Kuffner and LaValle 2000, "RRT-Connect: an efficient
approach to single-query path planning"). In space and time, nodes have a time as well, and edges only lead forwards in
it, no faster than the joints can move. A node is a row [coordinates, time]. All draws follow from a seed and a count.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.planning import is_clear_between
from qpavoid.problem import Array, IntArray

_SHORTER = 1.0 / 3.0
"""Fraction of an edge that is tried where the edge is not clear [-]."""
_LONGEST_TIME = 0.5
"""Duration of an edge at most [s], in space and time."""
_WIDTH = 0.3
"""Half width of the band around the straight motion to a goal that a third of the samples is from [rad or m]."""
_GAIN = 1e-3
"""Time that a shortcut has to save [s]."""
_MASK = 0xFFFFFFFF


@compiled
def draw(seed: int, number: int) -> float:
    """Return draw `number` of a seed, uniform in [0, 1): a hash of the two, without a state.

    Products of 32 bits and constants below 2³¹ do not overflow, so that plain Python draws the same numbers.
    """
    x = (seed * 0x1E35A7BD + 0x3C6EF372) & _MASK
    for part in (number & 0xFFFF, number >> 16):
        x = (x ^ part) & _MASK
        x = ((x ^ (x >> 16)) * 0x21F0AAAD) & _MASK
        x = ((x ^ (x >> 15)) * 0x735A2D97) & _MASK
        x ^= x >> 15
    return x / 4294967296.0


@compiled
def travel_between(x: Any, a: Array, b: Array) -> float:
    """Compute the metric of the trees [m]: the root of the sum of squares of the coordinates' travels."""
    square, weights = 0.0, x.travel
    for i in range(len(weights)):
        square += (weights[i] * (b[i] - a[i])) ** 2
    return np.sqrt(square)


@compiled
def shortest_time(x: Any, a: Array, b: Array) -> float:
    """Compute the time that the slowest coordinate needs between two nodes [s]."""
    longest = 0.0
    for i in range(len(x.speed)):
        longest = max(longest, abs(b[i] - a[i]) / x.speed[i])
    return longest


@compiled
def _nearest(x: Any, nodes: Array, count: int, node: Array, is_timed: bool, direction: float) -> int:
    """Find the nearest node of a tree from which a node can be attained in time; -1 where there is none."""
    best, nearest, weights, n = np.inf, -1, x.travel, len(node) - 1
    for k in range(count):
        square = 0.0
        for i in range(n):
            difference = weights[i] * (nodes[k, i] - node[i])
            square += difference * difference
        if square < best and (not is_timed or shortest_time(x, nodes[k], node) <= direction * (node[n] - nodes[k, n])):
            best, nearest = square, k
    return nearest


@compiled
def _extend(
    x: Any, nodes: Array, count: int, near: int, node: Array, need: Array, is_timed: bool, direction: float
) -> tuple[bool, bool]:
    """Append a step from node `near` of a tree towards another node.

    Returns:
        Whether the step is clear, so that it was appended; whether it ends at the node.
    """
    n, start, new = len(x.travel), nodes[near], nodes[count]
    fraction = min(1.0, x.longest / max(travel_between(x, start, node), 1e-12))
    if is_timed:
        fraction = min(fraction, _LONGEST_TIME / max(abs(node[n] - start[n]), 1e-12))
    for _ in range(2):
        for i in range(n + 1):
            new[i] = start[i] + fraction * (node[i] - start[i])
        first, second = (start, new) if direction > 0.0 else (new, start)
        if is_clear_between(x, first[:n], first[n], second[:n], second[n], need):
            return True, fraction == 1.0
        fraction *= _SHORTER
    return False, False


@compiled
def _sample(x: Any, start: Array, goals: Array, turn: int, seed: int, is_timed: bool, node: Array) -> None:
    """Write sample `turn`: first a goal, then by turns from everywhere, from a band around the motion to a goal, and
    from a wider band in which half of the coordinates are on that motion.
    """
    n, number = len(x.travel), turn * (2 * len(x.travel) + 3)
    goal = goals[int(draw(seed, number) * len(goals))]
    s, kind = draw(seed, number + 1), turn % 3
    node[n] = start[n] + (goal[n] - start[n]) * draw(seed, number + 2) if is_timed else start[n]
    width = _WIDTH if kind == 1 else 1.0
    for i in range(n):
        u = draw(seed, number + 3 + i)
        if kind == 0:
            node[i] = x.lower[i] + u * (x.upper[i] - x.lower[i])
        else:
            value = start[i] + s * (goal[i] - start[i])
            if kind == 1 or draw(seed, number + 3 + n + i) < 0.5:
                value += width * (2.0 * u - 1.0)
            node[i] = min(max(value, x.lower[i]), x.upper[i])
    if turn == 0:
        node[:] = goals[0]


@compiled
def connect(
    x: Any, start: Array, goals: Array, need: Array, is_timed: bool, max_nodes: int, max_checks: int, seed: int
) -> tuple[Array, int]:
    """Find a clear path from a start to one of some goals.

    Args:
        x: memory of the plan, see `PlanningArrays`.
        start: node (n + 1,).
        goals: nodes (g, n + 1); the first one is tried first.
        need: distance that each pair needs (k,) [m].
        is_timed: whether obstacles move, so that nodes have to be attained at their times.
        max_nodes: of both trees.
        max_checks: value of `x.checks` from which on the search ends.
        seed: of the draws.

    Returns:
        Nodes of the path (p, n + 1), from the start to a goal; none where none was found. Number of nodes of the trees.
    """
    n, g = len(start) - 1, len(goals)
    nodes, parents = np.empty((2, max_nodes + g + 2, n + 1)), np.full((2, max_nodes + g + 2), -1)
    size, node = np.array([1, g]), np.empty(n + 1)
    nodes[0, 0] = start
    nodes[1, :g] = goals
    for turn in range(4 * max_nodes):
        if size[0] + size[1] >= max_nodes + g or x.checks[0] >= max_checks:
            break
        a, b = turn % 2, 1 - turn % 2
        direction = 1.0 - 2.0 * a
        _sample(x, start, goals, turn, seed, is_timed, node)
        near = _nearest(x, nodes[a], size[a], node, is_timed, direction)
        if near < 0 or not _extend(x, nodes[a], size[a], near, node, need, is_timed, direction)[0]:
            continue
        new = size[a]
        parents[a, new] = near
        size[a] += 1
        near = _nearest(x, nodes[b], size[b], nodes[a, new], is_timed, -direction)
        is_reached = False
        while near >= 0 and not is_reached and size[b] < nodes.shape[1]:
            is_clear, is_reached = _extend(x, nodes[b], size[b], near, nodes[a, new], need, is_timed, -direction)
            if not is_clear:
                near, is_reached = -1, False
            else:
                parents[b, size[b]] = near
                near = size[b]
                size[b] += 1
        if is_reached:
            ends = (new, near) if a == 0 else (near, new)
            return _joined(nodes, parents, ends[0], ends[1]), size[0] + size[1]
    return np.empty((0, n + 1)), size[0] + size[1]


@compiled
def _joined(nodes: Array, parents: IntArray, first: int, second: int) -> Array:
    """Return the nodes from the root of the first tree to node `first`, then from `second` to its root."""
    count, k = 0, first
    while k >= 0:
        count, k = count + 1, parents[0, k]
    k, total = parents[1, second], count  # `second` is where `first` is
    while k >= 0:
        total, k = total + 1, parents[1, k]
    path, k = np.empty((total, nodes.shape[2])), first
    for i in range(count - 1, -1, -1):
        path[i] = nodes[0, k]
        k = parents[0, k]
    k = parents[1, second]
    for i in range(count, total):
        path[i] = nodes[1, k]
        k = parents[1, k]
    return path


@compiled
def shorten(x: Any, path: Array, need: Array, is_timed: bool, rounds: int, seed: int) -> Array:
    """Replace parts of a path by straight motions that are clear and take less time.

    Each round tries one between two random points of the path, a third of them between nodes; in space and time, only
    between nodes.

    Args:
        x: memory of the plan, see `PlanningArrays`.
        path: nodes (p, n + 1).
        need: distance that each pair needs (k,) [m].
        is_timed: whether nodes have to be attained at their times.
        rounds: how many are tried.
        seed: of the draws.
    """
    n, count = path.shape[1] - 1, len(path)
    nodes, p, r = np.empty((count + 2 * rounds, n + 1)), np.empty(n + 1), np.empty(n + 1)
    nodes[:count] = path
    for k in range(rounds):
        if count < 3:
            break
        i, j = int(draw(seed, 5 * k) * (count - 1)), int(draw(seed, 5 * k + 1) * (count - 1))
        i, j = min(i, j), max(i, j)
        if i == j:
            continue
        s, u = draw(seed, 5 * k + 2), draw(seed, 5 * k + 3)
        if is_timed or draw(seed, 5 * k + 4) < 1.0 / 3.0:
            s, u = 0.0, 1.0
        for c in range(n + 1):
            p[c] = nodes[i, c] + s * (nodes[i + 1, c] - nodes[i, c])
            r[c] = nodes[j, c] + u * (nodes[j + 1, c] - nodes[j, c])
        if not is_timed:
            time = shortest_time(x, p, nodes[i + 1]) + shortest_time(x, nodes[j], r)
            for c in range(i + 1, j):
                time += shortest_time(x, nodes[c], nodes[c + 1])
            if shortest_time(x, p, r) > time - _GAIN:
                continue
        if is_clear_between(x, p[:n], p[n], r[:n], r[n], need):
            count = _replace(nodes, count, i, j, p, r, s > 0.0, u < 1.0)
    return nodes[:count].copy()


@compiled
def _replace(nodes: Array, count: int, i: int, j: int, p: Array, r: Array, has_p: bool, has_r: bool) -> int:
    """Replace nodes i + 1 to j by p and r, where they are no nodes themselves; return how many nodes there are."""
    put, change = i + 1, int(has_p) + int(has_r) - (j - i)
    if change < 0:
        for c in range(j + 1, count):
            nodes[c + change] = nodes[c]
    else:
        for c in range(count - 1, j, -1):
            nodes[c + change] = nodes[c]
    if has_p:
        nodes[put] = p
        put += 1
    if has_r:
        nodes[put] = r
    return count + change
