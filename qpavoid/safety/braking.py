"""Looks ahead before a velocity is commanded: along its tick, and along the stop that would follow.

The rows of a problem are a linearisation, and they know only what is near. What is commanded must hold for the real
distances, of all pairs, at q ⊕ v dt with obstacles moved on; and it must leave a way to stop. So every velocity is
followed for one tick and then slowed down uniformly, as the joint limits allow, and the distances along that way are
computed anew. Where it comes too near, a solution that moves the joints less is tried, whose way
bends less; and that is drawn back towards the stop of this tick, whose way was looked at one tick ago. By induction a
stop that was found clear is always at hand, as long as obstacles do what they were last seen to do, for one tick.

Most ticks need none of this: where no body moves fast enough, or not in the direction, to use up what is left of a
distance before the robot could stop, the velocity is clear as it is (`kernels.clearance_lower_bound`, with the
bound and its proof).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import floor
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.control.assembler import Assembly
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.trajectories import extrapolate
from qpavoid.kernels import TOLERANCE, speed_to_stop
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray, Problem, Solution

_CREEP = 1e-5
"""How much nearer a pair that is too near already may come in a tick [m]."""
_FINEST = 5e-3
"""How far the fastest point moves between poses that are looked at, at the least [m]."""
_FARTHEST = 0.04
"""Distance beyond the safe one up to which pairs are looked at [m]."""
_MOST_POSES = 48
"""Poses that are looked at along one way, about."""
_MOST_TICKS = 200
"""Ticks of a stop that are followed."""
_CLOSE = 2e-3
"""What is left of a distance below which it is looked for where on a bent way it is least [m]."""
_CLOSER = 6
"""Looks that are spent on that."""
_NOISE = 1e-4
"""By how much the least that is found on the same bent way may differ from tick to tick [m]."""
_SLOWEST = 1e-3
"""Speed from which a bent way is looked at in steps of time [m/s]."""
_PATIENCE = 0.1
"""For how long a speed that a row misses counts, where nothing is clear: a stop lets an obstacle come on [s]."""
_SHARES = (0.75, 0.5, 0.25, 0.0)
"""Shares of the velocity, the rest being the stop, that are tried where it leads too near."""


class Checked(NamedTuple):
    """A velocity that was looked at."""

    v: Array
    """(nv,)."""
    share: float
    """How much of the wanted velocity is in it; the rest is the stop."""
    short: float
    """How much too near it leads all the same [m]; 0 where it is clear."""
    pair: int
    """Which pair comes too near; -1 where none does."""
    distance: float
    """Least distance of any pair along it, less the margins of stale obstacles [m]; negative: contact is predicted."""


class _Look(NamedTuple):
    """What was seen at a place of a way."""

    t: float
    pose: Array
    left: float
    """Least of distance - what it has to be [m]."""
    pair: int


class BrakingCheck:
    """Follows velocities ahead in time, on kinematics and distances of its own."""

    def __init__(
        self,
        scene: Scene,
        bounds: JointBounds,
        position_gain: float,
        hold: float,
        dt: float,
    ) -> None:
        """Lays the memory out.

        Args:
            scene: robot and obstacles.
            bounds: limits of the joints.
            position_gain: share of the room to a position limit that one tick may use [-].
            hold: safe distance between surfaces [m].
            dt: how long a velocity is held [s].
        """
        self._model, self._hold, self._dt = scene.robot.model, hold, dt
        self._data, self._ahead = scene.robot.model.createData(), DistanceQuery(scene)
        self._bounds, self._rate = bounds, position_gain / dt
        self._acceleration, self._accelerated = bounds.acceleration, bool(np.isfinite(bounds.acceleration).any())
        self._jerked = bool(np.isfinite(bounds.jerk).any())
        self._given, self._distance_allowance = np.zeros(len(scene.pairs)), scene.distance_allowance(hold)
        self._least = np.inf  # distance of any pair in the looks along the velocity under test [m]
        self._news, self._heard = np.zeros(len(scene.obstacles), dtype=bool), False

    def see(self, which: IntArray) -> None:
        """There is news of some obstacles (k,): they are not where they were last placed ahead."""
        self._news[which] = self._heard = True

    @property
    def ahead(self) -> DistanceQuery:
        """Distances along the way, for what has to know who carries what."""
        return self._ahead

    def forget(self, index: int) -> None:
        """Takes obstacle number `index` as resting where it is, or as carried."""
        self._news[index] = False

    def check(
        self,
        q: Array,
        solution: Solution,
        problem: Problem,
        low_effort: Callable[[], Array | None],
        assembly: Assembly,
        query: DistanceQuery,
        reach: float,
    ) -> Checked | None:
        """None where the way of a solution's velocity is clear, else as much of it as can be had.

        Where the solution lets a pair come nearer on purpose, because it had to, that is not held against it.

        Args:
            q: configuration (nq,).
            solution: the law's.
            problem: what it is a solution of.
            low_effort: gives another solution that moves the joints less, if there is one.
            assembly: of this tick.
            query: distances of this tick.
            reach: surface distance up to which they were looked for [m].
        """
        v, v_stop, rows = solution.v, problem.v_stop, problem.avoidance
        if problem.clear and v.tobytes() == problem.v_tracking.tobytes():
            return None
        near = rows.pair
        stop = assembly.stop(q, v) if self._jerked else None
        horizon = self._dt + 0.5 * self._stopping(v) if stop is None else float(stop.forwards.sum())
        uniform = horizon <= self._dt or stop is not None or not assembly.leaves_position_limits(q, v, horizon)
        if uniform and assembly.clearance_lower_bound(v, len(near), reach, horizon, stop) > -TOLERANCE:
            return None
        self._given.fill(0.0)
        self._least = np.inf
        if solution.slack is not None:
            self._given[near] = 1.1 * horizon * solution.slack
            self._given[:] = self._ahead.widest(self._given)
        self._place_obstacles(query)
        speed = float(query.placing.speeds.max())
        gap = (float(query.found(query.pairs).min()) if len(near) else reach) - self._hold
        look = partial(self._worst_of_stop if self._jerked else self._worst, assembly)
        worst, pair = look(q, v, query, gap, speed)
        if worst >= 0.0:
            return None
        best, price = Checked(v, 1.0, -worst, pair, self._least), -worst
        straight = low_effort()
        full = v if straight is None else straight
        for share in _SHARES if straight is None else (1.0, *_SHARES):
            blend, self._least = v_stop + share * (full - v_stop), np.inf
            worst, pair = look(q, blend, query, gap, speed)
            if worst >= (-_NOISE if self._jerked and share == 0.0 else 0.0):  # a stop was clear one tick ago
                return Checked(blend, share, 0.0, -1, self._least)
            missed = np.max(rows.b - rows.J @ blend - (0.0 if solution.slack is None else solution.slack), initial=0.0)
            if _PATIENCE * missed - worst < price:
                best, price = Checked(blend, share, -worst, pair, self._least), _PATIENCE * missed - worst
        return best

    def _place_obstacles(self, now: DistanceQuery) -> None:
        """Puts the obstacles where they will be at the end of the tick."""
        if self._heard:
            which = np.flatnonzero(self._news)
            states = now.placing.states.copy()
            extrapolate(states, self._dt)
            self._ahead.placing.place(which, states, now.placing.margin)
            self._news[which] = states[which, 12:].any(axis=1)  # those that move will be elsewhere at the next tick
            self._heard = bool(self._news.any())
        self._ahead.placing.margin[:] = now.placing.margin

    def _worst(
        self, assembly: Assembly, q: Array, v: Array, now: DistanceQuery, gap: float, speed: float
    ) -> tuple[float, int]:
        """Least of distance - what it has to be, along the way of v and its stop [m], and the pair that it is of.

        The steps are such that no two bodies can meet in between, and no shorter than `_FINEST`: what a pair could come
        nearer within one of those is of second order in it, as it was not too near at either end.

        Args:
            assembly: of this tick.
            q: start (nq,).
            v: velocity (nv,).
            now: distances there.
            gap: by how much the nearest pair is farther apart than it has to be [m].
            speed: that no point of the robot exceeds [m/s].
        """
        worst, pair, looks = np.inf, -1, 0
        pieces = self._way(assembly, q, v)
        left = sum(duration for *_, duration in pieces)
        for start, along, duration in pieces:
            t = 0.0
            while t < duration:
                step = max(0.5 * gap, _FINEST, speed * left / (_MOST_POSES - looks)) / max(speed, 1e-9)
                # the end of the tick is always looked at, and the last of all poses is the end
                until = self._dt if t < self._dt and not looks else duration
                last = looks >= _MOST_POSES - 1 or step >= until - t
                step = until - t if last else step
                t, left, looks = until if last else t + step, left - step, min(looks + 1, _MOST_POSES - 1)
                found, which = self._look(pin.integrate(self._model, start, t * along), now)
                if not found >= worst:
                    worst, pair = found, which
                gap = min(max(found, 0.0), _FARTHEST)
        return worst, pair

    def _worst_of_stop(
        self, assembly: Assembly, q: Array, v: Array, now: DistanceQuery, gap: float, speed: float
    ) -> tuple[float, int]:
        """`_worst` where jerks have limits: that way bends, and may come nearest anywhere between two looks."""
        stop, speed = assembly.stop(q, v), max(speed, _SLOWEST)
        # at such times no point moves faster than `speed`
        times = np.concatenate(([0.0], np.cumsum(np.maximum(stop.forwards + stop.aside / speed, 1e-9))))
        ways = np.concatenate((np.zeros((1, len(v))), np.cumsum(self._dt * stop.way, axis=0)))

        def walk(pose: Array, start: float, end: float) -> Array:
            places = []
            for t in (start, end):
                k = min(int(np.searchsorted(times, t, side="right")), len(times) - 1)
                places.append(ways[k] - (times[k] - t) / (times[k] - times[k - 1]) * (ways[k] - ways[k - 1]))
            return np.asarray(pin.integrate(self._model, pose, places[1] - places[0]))

        def look(before: _Look, t: float) -> _Look:
            pose = walk(before.pose, before.t, t)
            return _Look(t, pose, *self._look(pose, now))

        seen = [_Look(0.0, q, gap, -1)]
        while (t := seen[-1].t) < times[-1]:
            looks = _MOST_POSES - len(seen)
            step = max(0.5 * min(max(seen[-1].left, 0.0), _FARTHEST), _FINEST) / speed
            step = max(step, (times[-1] - t) / max(looks, 1))
            # the end of the tick is always looked at, and the last of all poses is the end
            end = times[1] if len(seen) == 1 else times[-1]
            seen.append(look(seen[-1], float(end if looks <= 1 else min(t + step, end))))
        found = [*seen[1:], look(seen[-2], 0.5 * (seen[-2].t + seen[-1].t))]  # it may turn back just before its end
        for before, here, after in zip(seen[:-2], seen[1:-1], seen[2:], strict=True):
            if not (before.left >= here.left <= after.left and here.left < _CLOSE):
                continue
            for _ in range(_CLOSER):
                first = here.t - before.t > after.t - here.t
                between = look(here, 0.5 * (here.t + (before.t if first else after.t)))
                found.append(between)
                if between.left < here.left:
                    before, here, after = (before, between, here) if first else (here, between, after)
                else:
                    before, after = (between, after) if first else (before, between)
        least = found[int(np.argmin([each.left for each in found]))]  # the first NaN, where there is one
        return least.left, least.pair

    def _way(self, assembly: Assembly, q: Array, v: Array) -> list[tuple[Array, Array, float]]:
        """Straight pieces of the way of v and its stop: where each starts, its velocity and for how long [s]."""
        end = self._end(self._stopping(v))
        if end > self._dt and assembly.leaves_position_limits(q, v, end):
            return self._bent_way(q, v)
        return [(q, v, end)]

    def _bent_way(self, q: Array, v: Array) -> list[tuple[Array, Array, float]]:
        """The ticks of v and of the stop from it, where some joints have to brake harder for their limits.

        A joint that uniform slowing leaves inside its limits is never clipped on the way, because what is left of its
        way then suffices for braking all the more; so the way is straight unless its end lies outside.
        """
        x, dt = self._bounds, self._dt
        step, i, j = x.acceleration * dt, x.q_index, x.v_index
        limited = np.isfinite(step[j])
        finite_step = np.where(limited, step[j], 1.0)
        pieces: list[tuple[Array, Array, float]] = []
        while len(pieces) < _MOST_TICKS:
            pieces.append((q, v, dt))
            q = pin.integrate(self._model, q, dt * v)
            slowing = float((np.abs(v) / step).max())
            if slowing <= 1.0:
                break
            room = np.maximum(np.array([q[i] - x.lower, x.upper - q[i]]), 0.0)
            down, up = np.where(limited, speed_to_stop(room, finite_step, dt), self._rate * room)
            following = (1.0 - 1.0 / slowing) * v
            hardest = v[j] - step[j], v[j] + step[j]
            following[j] = np.clip(following[j], np.maximum(-down, hardest[0]), np.minimum(up, hardest[1]))
            v = following
        return pieces

    def _end(self, stopping: float) -> float:
        """Time for which v leads as far as v and the ticks of its stop: dt Σ (1 - i dt / stopping), i = 0, 1, … [s]."""
        n = stopping / self._dt
        m = floor(n)
        return self._dt * (1.0 + m - (0.5 * m * (m + 1) / n if m else 0.0))

    def _stopping(self, v: Array) -> float:
        """Time that the stop from v takes [s]."""
        return float((np.abs(v) / self._acceleration).max()) if self._accelerated else 0.0

    def _look(self, q: Array, now: DistanceQuery) -> tuple[float, int]:
        pin.forwardKinematics(self._model, self._data, q)
        ahead = self._ahead
        ahead.compute(self._data, self._hold + _FARTHEST)
        pairs = ahead.pairs
        if not len(pairs):
            return _FARTHEST, -1
        there, here = (
            ahead.found(pairs) + self._distance_allowance[pairs],
            now.found(pairs) + self._distance_allowance[pairs],
        )
        margins = ahead.placing.margin
        if margins.any():
            margin = margins[ahead.twist_row[pairs]]
            there, here = there - margin, here - margin
        self._least = min(self._least, float(there.min()))
        left = there - np.minimum(self._hold - TOLERANCE, here - _CREEP) + self._given[pairs]
        worst = int(left.argmin())  # the first NaN, where there is one
        return float(left[worst]), int(pairs[worst])
