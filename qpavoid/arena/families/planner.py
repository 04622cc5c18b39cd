"""A motion from start to goal, as proof that there is one: RRT-Connect, in space, or in space and time.

Two trees grow towards each other, one from the start, the other from configurations that attain the goal (Kuffner and
LaValle, "RRT-Connect", ICRA 2000). Where obstacles move, nodes have a time, edges keep to joint speeds, and the tree of
the goal begins at the end of the run (as ST-RRT*, Grothe et al., ICRA 2022, without the optimising).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.arena.families.clearance import Clearance
from qpavoid.arena.families.reach import Ranges
from qpavoid.problem import Array

MOST_NODES = 4000
"""Both trees together may have so many; a plan is given up then."""
_MOST_ROUNDS = 2 * MOST_NODES
_LONGEST = 0.6
"""Longest edge of a tree: how far any point moves on it, at most [m]."""
_LONGEST_TIME = 0.5
"""The same in time [s]."""
_NEAR = 0.8
"""How far from the straight motion two samples of three may be, in each joint [rad or m]."""
_SHORTCUTS = 60


class Plan(NamedTuple):
    """A motion, straight in the joints from node to node."""

    q: Array
    """(k, nv)."""
    t: Array
    """(k,) when it is there [s]; by the joints' speeds where nothing else moves."""
    nodes: int
    """How many both trees had."""

    @property
    def length(self) -> float:
        """Of the path in the joints' coordinates, Euclidean [rad, and m for sliding joints]."""
        return float(np.linalg.norm(np.diff(self.q, axis=0), axis=1).sum())


class _Tree:
    """Nodes q (nv,) at times t that were reached from each other."""

    def __init__(self, roots: Array, t: float, forward: bool) -> None:
        self.q = np.empty((MOST_NODES + len(roots), roots.shape[1]))
        self.t, self.parent = np.full(len(self.q), t), np.full(len(self.q), -1)
        self.q[: len(roots)], self.count, self.forward = roots, len(roots), forward

    def add(self, q: Array, t: float, parent: int) -> int:
        self.q[self.count], self.t[self.count], self.parent[self.count] = q, t, parent
        self.count += 1
        return self.count - 1

    def trace(self, node: int) -> list[int]:
        """From a node back to its root."""
        nodes = []
        while node >= 0:
            nodes.append(node)
            node = int(self.parent[node])
        return nodes


class _Search:
    """What both trees share."""

    def __init__(self, clearance: Clearance, speed: Array) -> None:
        self._clearance, self._speed, self._timed = clearance, speed, clearance.timed

    def nearest(self, tree: _Tree, q: Array, t: float) -> int:
        """The node of a tree from which (or to which) q at t can be reached with the least motion; -1 if none."""
        way = np.abs(tree.q[: tree.count] - q)
        cost = way @ self._clearance.lever_arm
        if self._timed:
            time = t - tree.t[: tree.count] if tree.forward else tree.t[: tree.count] - t
            cost[(way / self._speed).max(axis=1) > time] = np.inf
        node = int(np.argmin(cost))
        return node if np.isfinite(cost[node]) else -1

    def extend(self, tree: _Tree, node: int, q: Array, t: float) -> tuple[int, bool]:
        """A node one edge on from another one towards q at t, and whether that is q itself; -1 if it is not clear."""
        way, time = q - tree.q[node], t - float(tree.t[node])
        cost = float(self._clearance.lever_arm @ np.abs(way))
        share = min(1.0, _LONGEST / max(cost, 1e-12), _LONGEST_TIME / abs(time) if self._timed and time else 1.0)
        there, then = tree.q[node] + share * way, float(tree.t[node]) + share * time
        ends = (tree.q[node], float(tree.t[node]), there, then)
        if not self._clearance.clear_between(*(ends if tree.forward else (*ends[2:], *ends[:2]))):
            return -1, False
        return tree.add(there, then, node), share == 1.0


def plan(
    clearance: Clearance,
    ranges: Ranges,
    start: Array,
    goals: Array,
    speed: Array,
    duration: float,
    random: np.random.Generator,
) -> Plan | None:
    """A motion from start to one of the goals, within the duration; None if none was found.

    Args:
        clearance: of the scene, and what is to be kept.
        ranges: of the joints.
        start: (nv,), clear at time 0.
        goals: (g, nv), clear at the end.
        speed: (nv,) that joints may have [rad/s or m/s].
        duration: of the run [s].
        random: where samples come from.
    """
    search, last = _Search(clearance, speed), duration if clearance.timed else 0.0
    trees = (_Tree(start[None], 0.0, True), _Tree(goals, last, False))
    for turn in range(_MOST_ROUNDS):
        tree, other = trees[turn % 2], trees[1 - turn % 2]
        if tree.count + other.count > MOST_NODES:
            return None
        q, t = (goals[0], last) if turn == 0 else _sample(ranges, start, goals, turn, last, random)
        node = search.nearest(tree, q, t)
        if node < 0:
            continue
        new, _ = search.extend(tree, node, q, t)
        if new < 0:
            continue
        met = _connect(search, other, tree.q[new], float(tree.t[new]))
        if met >= 0:
            one, two = (new, met) if tree.forward else (met, new)
            there, back = trees[0].trace(one)[::-1], trees[1].trace(two)[1:]  # both end where the trees met
            q_path = np.concatenate((trees[0].q[there], trees[1].q[back]))
            t_path = np.concatenate((trees[0].t[there], trees[1].t[back]))
            found = _shortened(clearance, q_path, t_path, random)
            return _in_time(Plan(*found, trees[0].count + trees[1].count), speed, duration, clearance.timed)
    return None


def _connect(search: _Search, tree: _Tree, q: Array, t: float) -> int:
    """The node of a tree that has come to q at t; -1 if something is in the way."""
    node, there = search.nearest(tree, q, t), False
    while node >= 0 and not there and tree.count < len(tree.q):
        node, there = search.extend(tree, node, q, t)
    return node if there else -1


def _sample(
    ranges: Ranges, start: Array, goals: Array, turn: int, last: float, random: np.random.Generator
) -> tuple[Array, float]:
    """Somewhere: two times in three near the straight motion to a goal."""
    t = float(random.uniform(0.0, last))
    anywhere = random.uniform(ranges.lower, ranges.upper)
    goal, share, aside = goals[random.integers(len(goals))], random.uniform(), random.uniform(-_NEAR, _NEAR, len(start))
    if turn % 3 == 0:
        return anywhere, t
    return np.clip(start + share * (goal - start) + aside, ranges.lower, ranges.upper), t


def _shortened(clearance: Clearance, q: Array, t: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """The path without detours that straight edges can cut off."""
    for _ in range(_SHORTCUTS):
        if len(q) < 3:
            break
        i = int(random.integers(0, len(q) - 2))
        j = int(random.integers(i + 2, len(q)))
        if clearance.clear_between(q[i], float(t[i]), q[j], float(t[j])):
            q, t = np.delete(q, slice(i + 1, j), axis=0), np.delete(t, slice(i + 1, j))
    return q, t


def _in_time(found: Plan, speed: Array, duration: float, timed: bool) -> Plan | None:
    """The plan with times, where nothing but the robot moves; None if it takes too long."""
    if timed:
        return found
    t = np.concatenate(([0.0], np.cumsum((np.abs(np.diff(found.q, axis=0)) / speed).max(axis=1))))
    return found._replace(t=t) if t[-1] <= duration else None
