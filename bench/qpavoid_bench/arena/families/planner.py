"""Motion planning as proof of a solution: RRT-Connect, in space or space and time.

Two trees grow towards each other, one from the start, the other from configurations that attain the goal (Kuffner and
LaValle, "RRT-Connect", ICRA 2000). Where obstacles move, nodes have a time, edges keep to joint speeds, and the tree of
the goal begins at the end of the run (as ST-RRT*, Grothe et al., ICRA 2022, without the optimising).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.problem import Array
from qpavoid_bench.arena.families.clearance import Clearance
from qpavoid_bench.arena.families.inverse_kinematics import JointRanges

MAX_NODES = 4000
"""Largest number of nodes of both trees together; a plan fails beyond it."""
_MAX_ROUNDS = 2 * MAX_NODES
_MAX_EDGE = 0.6
"""Longest edge of a tree: bound on the travel of any point on it [m]."""
_MAX_EDGE_TIME = 0.5
"""Longest duration of an edge [s]."""
_SAMPLE_WIDTH = 0.8
"""Largest distance of two samples of three from the straight motion, in each joint [rad or m]."""
_SHORTCUTS = 60


class Plan(NamedTuple):
    """A motion, straight in the joints from node to node."""

    q: Array
    """(k, nv)."""
    t: Array
    """(k,) time of each node [s]; by the joints' speeds where nothing else moves."""
    nodes: int
    """Number of nodes of both trees."""

    @property
    def length(self) -> float:
        """Return the Euclidean length of the path in joint coordinates [rad or m]."""
        return float(np.linalg.norm(np.diff(self.q, axis=0), axis=1).sum())


class _Tree:
    """Nodes q (nv,) at times t, each connected to its parent."""

    def __init__(self, roots: Array, t: float, forward: bool) -> None:
        self.q = np.empty((MAX_NODES + len(roots), roots.shape[1]))
        self.t, self.parent = np.full(len(self.q), t), np.full(len(self.q), -1)
        self.q[: len(roots)], self.count, self.forward = roots, len(roots), forward

    def add(self, q: Array, t: float, parent: int) -> int:
        self.q[self.count], self.t[self.count], self.parent[self.count] = q, t, parent
        self.count += 1
        return self.count - 1

    def trace(self, node: int) -> list[int]:
        """Return the nodes from a node back to its root."""
        nodes = []
        while node >= 0:
            nodes.append(node)
            node = int(self.parent[node])
        return nodes


class _Search:
    """Distance and extension of nodes, common to both trees."""

    def __init__(self, clearance: Clearance, speed: Array) -> None:
        self._clearance, self._speed, self._depends_on_time = clearance, speed, clearance.depends_on_time

    def nearest(self, tree: _Tree, q: Array, t: float) -> int:
        """Return the node of a tree that connects to q at t with the least motion; -1 if none."""
        dq = np.abs(tree.q[: tree.count] - q)
        cost = dq @ self._clearance.lever_arm
        if self._depends_on_time:
            time = t - tree.t[: tree.count] if tree.forward else tree.t[: tree.count] - t
            cost[(dq / self._speed).max(axis=1) > time] = np.inf
        node = int(np.argmin(cost))
        return node if np.isfinite(cost[node]) else -1

    def extend(self, tree: _Tree, node: int, q: Array, t: float) -> tuple[int, bool]:
        """Add a node one edge from another one towards q at t; return it, and whether it is q.

        The node is -1 if the edge is not clear.
        """
        dq, time = q - tree.q[node], t - float(tree.t[node])
        cost = float(self._clearance.lever_arm @ np.abs(dq))
        fraction = min(
            1.0, _MAX_EDGE / max(cost, 1e-12), _MAX_EDGE_TIME / abs(time) if self._depends_on_time and time else 1.0
        )
        q_new, t_new = tree.q[node] + fraction * dq, float(tree.t[node]) + fraction * time
        ends = (tree.q[node], float(tree.t[node]), q_new, t_new)
        if not self._clearance.is_clear_between(*(ends if tree.forward else (*ends[2:], *ends[:2]))):
            return -1, False
        return tree.add(q_new, t_new, node), fraction == 1.0


def plan(
    clearance: Clearance,
    ranges: JointRanges,
    start: Array,
    goals: Array,
    speed: Array,
    duration: float,
    random: np.random.Generator,
) -> Plan | None:
    """Plan a motion from start to one of the goals within the duration; None if none is found.

    Args:
        clearance: of the scene, and what is to be kept.
        ranges: of the joints.
        start: (nv,), clear at time 0.
        goals: (g, nv), clear at the end.
        speed: (nv,) that joints may have [rad/s or m/s].
        duration: of the run [s].
        random: where samples come from.
    """
    search, last = _Search(clearance, speed), duration if clearance.depends_on_time else 0.0
    trees = (_Tree(start[None], 0.0, True), _Tree(goals, last, False))
    for round_index in range(_MAX_ROUNDS):
        tree, other = trees[round_index % 2], trees[1 - round_index % 2]
        if tree.count + other.count > MAX_NODES:
            return None
        q, t = (goals[0], last) if round_index == 0 else _sample(ranges, start, goals, round_index, last, random)
        node = search.nearest(tree, q, t)
        if node < 0:
            continue
        new, _ = search.extend(tree, node, q, t)
        if new < 0:
            continue
        met = _connect(search, other, tree.q[new], float(tree.t[new]))
        if met >= 0:
            one, two = (new, met) if tree.forward else (met, new)
            start_side, goal_side = trees[0].trace(one)[::-1], trees[1].trace(two)[1:]  # both end where the trees met
            q_path = np.concatenate((trees[0].q[start_side], trees[1].q[goal_side]))
            t_path = np.concatenate((trees[0].t[start_side], trees[1].t[goal_side]))
            path = _shorten(clearance, q_path, t_path, random)
            return _assign_times(
                Plan(*path, trees[0].count + trees[1].count), speed, duration, clearance.depends_on_time
            )
    return None


def _connect(search: _Search, tree: _Tree, q: Array, t: float) -> int:
    """Extend a tree until it reaches q at t; return the node, or -1 if an obstacle stops it."""
    node, is_reached = search.nearest(tree, q, t), False
    while node >= 0 and not is_reached and tree.count < len(tree.q):
        node, is_reached = search.extend(tree, node, q, t)
    return node if is_reached else -1


def _sample(
    ranges: JointRanges, start: Array, goals: Array, round_index: int, last: float, random: np.random.Generator
) -> tuple[Array, float]:
    """Draw a sample: two of three near the straight motion to a goal, the others anywhere."""
    t = float(random.uniform(0.0, last))
    q_random = random.uniform(ranges.lower, ranges.upper)
    goal, fraction, offset = (
        goals[random.integers(len(goals))],
        random.uniform(),
        random.uniform(-_SAMPLE_WIDTH, _SAMPLE_WIDTH, len(start)),
    )
    if round_index % 3 == 0:
        return q_random, t
    return np.clip(start + fraction * (goal - start) + offset, ranges.lower, ranges.upper), t


def _shorten(clearance: Clearance, q: Array, t: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Cut detours of a path off with straight edges."""
    for _ in range(_SHORTCUTS):
        if len(q) < 3:
            break
        i = int(random.integers(0, len(q) - 2))
        j = int(random.integers(i + 2, len(q)))
        if clearance.is_clear_between(q[i], float(t[i]), q[j], float(t[j])):
            q, t = np.delete(q, slice(i + 1, j), axis=0), np.delete(t, slice(i + 1, j))
    return q, t


def _assign_times(path: Plan, speed: Array, duration: float, depends_on_time: bool) -> Plan | None:
    """Give a plan times where nothing but the robot moves; None if it takes too long."""
    if depends_on_time:
        return path
    t = np.concatenate(([0.0], np.cumsum((np.abs(np.diff(path.q, axis=0)) / speed).max(axis=1))))
    return path._replace(t=t) if t[-1] <= duration else None
