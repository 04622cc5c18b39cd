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
    """Nodes q (nv,) at times t, each connected to its parent; grows from its roots over clear edges."""

    def __init__(self, clearance: Clearance, speed: Array, roots: Array, t: float, forward: bool) -> None:
        self._clearance, self._speed, self._forward = clearance, speed, forward
        self.q = np.empty((MAX_NODES + len(roots), roots.shape[1]))
        self.t, self._parent = np.full(len(self.q), t), np.full(len(self.q), -1)
        self.q[: len(roots)], self.count = roots, len(roots)

    def nearest(self, q: Array, t: float) -> int:
        """Return the node that connects to q at t with the least motion; -1 if none."""
        dq = np.abs(self.q[: self.count] - q)
        cost = dq @ self._clearance.lever_arm
        if self._clearance.depends_on_time:
            time = t - self.t[: self.count] if self._forward else self.t[: self.count] - t
            cost[(dq / self._speed).max(axis=1) > time] = np.inf
        node = int(np.argmin(cost))
        return node if np.isfinite(cost[node]) else -1

    def extend(self, node: int, q: Array, t: float) -> tuple[int, bool]:
        """Add a node one edge from another one towards q at t; return it, and whether it is q.

        The node is -1 if the edge is not clear.
        """
        q_node, t_node = self.q[node], float(self.t[node])
        dq, time = q - q_node, t - t_node
        fraction = min(1.0, _MAX_EDGE / max(float(self._clearance.lever_arm @ np.abs(dq)), 1e-12))
        if self._clearance.depends_on_time and time:
            fraction = min(fraction, _MAX_EDGE_TIME / abs(time))
        q_new, t_new = q_node + fraction * dq, t_node + fraction * time
        edge = (q_node, t_node, q_new, t_new) if self._forward else (q_new, t_new, q_node, t_node)
        if not self._clearance.is_clear_between(*edge):
            return -1, False
        new, self.count = self.count, self.count + 1
        self.q[new], self.t[new], self._parent[new] = q_new, t_new, node
        return new, fraction == 1.0

    def connect(self, q: Array, t: float) -> int:
        """Extend until q at t is reached; return the node, or -1 if an obstacle stops it."""
        node, is_reached = self.nearest(q, t), False
        while node >= 0 and not is_reached and self.count < len(self.q):
            node, is_reached = self.extend(node, q, t)
        return node if is_reached else -1

    def trace(self, node: int) -> list[int]:
        """Return the nodes from a node back to its root."""
        nodes = []
        while node >= 0:
            nodes.append(node)
            node = int(self._parent[node])
        return nodes


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
    last = duration if clearance.depends_on_time else 0.0
    start_tree = _Tree(clearance, speed, start[None], 0.0, True)
    goal_tree = _Tree(clearance, speed, goals, last, False)
    for round_index in range(_MAX_ROUNDS):
        tree, other = (goal_tree, start_tree) if round_index % 2 else (start_tree, goal_tree)
        if tree.count + other.count > MAX_NODES:
            return None
        q, t = (goals[0], last) if round_index == 0 else _sample(ranges, start, goals, round_index, last, random)
        node = tree.nearest(q, t)
        new = tree.extend(node, q, t)[0] if node >= 0 else -1
        met = other.connect(tree.q[new], float(tree.t[new])) if new >= 0 else -1
        if met >= 0:
            one, two = (met, new) if round_index % 2 else (new, met)
            to_meeting, continuation = (
                start_tree.trace(one)[::-1],
                goal_tree.trace(two)[1:],
            )  # both have where the trees met
            q_path = np.concatenate((start_tree.q[to_meeting], goal_tree.q[continuation]))
            t_path = np.concatenate((start_tree.t[to_meeting], goal_tree.t[continuation]))
            q_path, t_path = _shorten(clearance, q_path, t_path, random)
            if not clearance.depends_on_time:
                times = (np.abs(np.diff(q_path, axis=0)) / speed).max(axis=1)
                t_path = np.concatenate(([0.0], np.cumsum(times)))
            return Plan(q_path, t_path, tree.count + other.count) if t_path[-1] <= duration else None
    return None


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
