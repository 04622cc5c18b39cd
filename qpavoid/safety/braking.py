"""Stop look-ahead: real distances along the control period of a velocity, and along the braking that would follow.

The rows of a problem are a linearisation, and they hold only pairs that are near. What is commanded must hold for the
real distances, of all pairs, at q ⊕ v dt with the obstacles of then; and it must leave room to brake. So every velocity
is followed for one control period and then slowed down uniformly, as the joint limits allow, and the distances along
that path are evaluated. Where a pair comes too near, a solution of less effort is tried, whose path is straighter; and
that is scaled towards the stop of this control step, whose path was verified one step ago. By induction a verified stop
is always available, as long as obstacles keep their velocities for one control period.

Most control steps need none of this: where no body moves fast enough, or not in the direction, to use up the margin of
a pair before the robot could stop, the velocity is clear (`kernels.clearance_lower_bound`, with the bound and its
proof).
"""

from __future__ import annotations

from collections.abc import Callable
from math import floor
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.control.assembler import RowAssembler
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.kernels import TOLERANCE, speed_to_stop
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Problem, Solution

_MAX_APPROACH_IN_VIOLATION = 1e-5
"""Approach per control step that a pair below its safety distance may make [m]: round-off of the row that parts it."""
_MIN_STEP = 5e-3
"""Least motion of the fastest point between two poses that are evaluated [m]; bounds their number."""
_MAX_MARGIN = 0.04
"""Distance beyond the safety distance up to which pairs are evaluated [m]: larger margins only set longer steps."""
_MAX_POSES = 48
"""Poses that are evaluated along one path, about [-]; bounds the time of a control step."""
_MAX_STOP_STEPS = 200
"""Control steps of a braking trajectory that are followed [-]."""
_REFINE_BELOW = 2e-3
"""Margin below which the least one along a curved path is refined [m]."""
_REFINEMENTS = 6
"""Evaluations per refinement [-]: they halve the interval each."""
_REFINEMENT_ERROR = 1e-4
"""Difference of the least margins of one curved path between two control steps that counts as none [m]."""
_MIN_SPEED = 1e-3
"""Least speed by which steps along a curved path are scaled [m/s]."""
_VIOLATION_TIME = 0.1
"""Time by which the violation of a row [m/s] counts as a distance [s], where no scale is clear: a stop lets an obstacle
that approaches come nearer."""
_SCALES = (0.75, 0.5, 0.25, 0.0)
"""Scales of the velocity that are tried where it leads too near [-]; the rest is the stop."""


class BrakingResult(NamedTuple):
    """A velocity that was checked."""

    v: Array
    """(nv,)."""
    command_scale: float
    """Scale of the velocity that was asked for [-]; the rest is the stop."""
    violation: float
    """By how much it leads too near all the same [m]; 0 where it is clear."""
    pair: int
    """Pair that comes too near; -1 for none."""
    distance: float
    """Least distance of any pair along it, less the margins of stale obstacles [m]; negative: contact is predicted."""


class _PathPoint(NamedTuple):
    """A pose along a path that was evaluated."""

    t: float
    q: Array
    """(nq,)."""
    margin: float
    """Least of distance - required distance [m]."""
    pair: int


class BrakingCheck:
    """Checks velocities ahead in time, on kinematics and distances of its own."""

    def __init__(
        self,
        scene: Scene,
        rows: RowAssembler,
        bounds: JointBounds,
        position_gain: float,
        safety_distance: float,
        dt: float,
    ) -> None:
        """Allocate all memory.

        Args:
            scene: robot and obstacles.
            rows: kinematics, distances and rows of the control step.
            bounds: limits of the joints.
            position_gain: fraction of the range left to a position limit that one control step may use [-].
            safety_distance: between surfaces [m].
            dt: control period [s].
        """
        self._model, self._safety_distance, self._dt = scene.robot.model, safety_distance, dt
        self._rows, self._now = rows, rows.query
        self._kinematics, self._query = ForwardKinematics(self._model), DistanceQuery(scene, rows.query.table)
        self._bounds, self._rate = bounds, position_gain / dt
        self._acceleration, self._accelerated = bounds.acceleration, bool(np.isfinite(bounds.acceleration).any())
        self._allowance, self._distance_allowance = (
            np.zeros(len(scene.pairs)),
            scene.distance_allowance(safety_distance),
        )
        self._min_distance = np.inf  # of any pair along the velocity under test [m]

    def check(
        self,
        q: Array,
        solution: Solution,
        problem: Problem,
        low_effort: Callable[[], Array | None],
        obstacles: ObstacleTracker,
    ) -> BrakingResult | None:
        """Return None if the path of a solution's velocity is clear, else the largest scale of it that is, or the best.

        Where the solution lets a pair come nearer on purpose, by a slack, that is allowed.

        Args:
            q: configuration (nq,).
            solution: the solver's.
            problem: the one that was solved.
            low_effort: returns another solution of less joint motion, if there is one.
            obstacles: states of the obstacles.
        """
        v, v_stop, rows = solution.v, problem.v_stop, problem.avoidance
        if problem.tracking_is_clear and v.tobytes() == problem.v_tracking.tobytes():
            return None
        near, now = rows.pair, self._now
        stop = self._rows.stop(q, v)
        horizon = self._dt + 0.5 * self._stopping_time(v) if stop is None else float(stop.equivalent_time.sum())
        is_uniform = horizon <= self._dt or stop is not None or not self._rows.leaves_position_limits(q, v, horizon)
        if is_uniform and self._rows.clearance_lower_bound(v, len(near), horizon, stop) > -TOLERANCE:
            return None
        self._allowance.fill(0.0)
        self._min_distance = np.inf
        if solution.slack is not None:
            self._allowance[near] = 1.1 * horizon * solution.slack
            self._allowance[:] = self._query.max_over_group(self._allowance)
        self._query.place(obstacles.after(self._dt))
        speed = float(now.arrays.speeds.max())
        nearest = float(now.distances_of(now.pairs).min()) if len(near) else self._rows.influence_distance
        margin = nearest - self._safety_distance
        evaluate = self._min_margin_with_jerk if stop is not None else self._min_margin
        least, pair = evaluate(q, v, margin, speed)
        if least >= 0.0:
            return None
        best, cost = BrakingResult(v, 1.0, -least, pair, self._min_distance), -least
        straight = low_effort()
        full = v if straight is None else straight
        for scale in _SCALES if straight is None else (1.0, *_SCALES):
            blend, self._min_distance = v_stop + scale * (full - v_stop), np.inf
            least, pair = evaluate(q, blend, margin, speed)
            # a stop was clear one control step ago
            if least >= (-_REFINEMENT_ERROR if stop is not None and scale == 0.0 else 0.0):
                return BrakingResult(blend, scale, 0.0, -1, self._min_distance)
            slack = 0.0 if solution.slack is None else solution.slack
            violation = np.max(rows.b - rows.J @ blend - slack, initial=0.0)
            if _VIOLATION_TIME * violation - least < cost:
                best = BrakingResult(blend, scale, -least, pair, self._min_distance)
                cost = _VIOLATION_TIME * violation - least
        return best

    def _min_margin(self, q: Array, v: Array, margin: float, speed: float) -> tuple[float, int]:
        """Return the least margin, distance - required distance, along the path of v and its stop [m], and its pair.

        Steps are such that no two bodies can meet in between, and no shorter than `_MIN_STEP`: the approach of a pair
        within one of those is of second order in it, as it was not too near at either end.

        Args:
            q: start (nq,).
            v: velocity (nv,).
            margin: least margin at the start [m].
            speed: bound on the speed of any point of the robot [m/s].
        """
        least, pair, count = np.inf, -1, 0
        segments = self._segments(q, v)
        remaining = sum(duration for *_, duration in segments)
        for start, velocity, duration in segments:
            t = 0.0
            while t < duration:
                step = max(0.5 * margin, _MIN_STEP, speed * remaining / (_MAX_POSES - count)) / max(speed, 1e-9)
                # the end of the control period is always evaluated, and the last of all poses is the end
                end = self._dt if t < self._dt and not count else duration
                is_last = count >= _MAX_POSES - 1 or step >= end - t
                step = end - t if is_last else step
                t, remaining = end if is_last else t + step, remaining - step
                count = min(count + 1, _MAX_POSES - 1)
                here, nearest = self._margin_at(pin.integrate(self._model, start, t * velocity))
                if not here >= least:
                    least, pair = here, nearest
                margin = min(max(here, 0.0), _MAX_MARGIN)
        return least, pair

    def _min_margin_with_jerk(self, q: Array, v: Array, margin: float, speed: float) -> tuple[float, int]:
        """Return what `_min_margin` does, under jerk limits: the path is curved, and may be nearest between poses."""
        stop, speed = self._rows.stop(q, v), max(speed, _MIN_SPEED)
        assert stop is not None
        # at such times no point moves faster than `speed`
        times = np.concatenate(([0.0], np.cumsum(np.maximum(stop.equivalent_time + stop.lateral_bound / speed, 1e-9))))
        travel = np.concatenate((np.zeros((1, len(v))), np.cumsum(self._dt * stop.velocities, axis=0)))

        def move(pose: Array, start: float, end: float) -> Array:
            places = []
            for t in (start, end):
                k = min(int(np.searchsorted(times, t, side="right")), len(times) - 1)
                places.append(travel[k] - (times[k] - t) / (times[k] - times[k - 1]) * (travel[k] - travel[k - 1]))
            return np.asarray(pin.integrate(self._model, pose, places[1] - places[0]))

        def evaluate(before: _PathPoint, t: float) -> _PathPoint:
            pose = move(before.q, before.t, t)
            return _PathPoint(t, pose, *self._margin_at(pose))

        path = [_PathPoint(0.0, q, margin, -1)]
        while (t := path[-1].t) < times[-1]:
            count = _MAX_POSES - len(path)
            step = max(0.5 * min(max(path[-1].margin, 0.0), _MAX_MARGIN), _MIN_STEP) / speed
            step = max(step, (times[-1] - t) / max(count, 1))
            # the end of the control period is always evaluated, and the last of all poses is the end
            end = times[1] if len(path) == 1 else times[-1]
            path.append(evaluate(path[-1], float(end if count <= 1 else min(t + step, end))))
        # the path may turn back just before its end
        points = [*path[1:], evaluate(path[-2], 0.5 * (path[-2].t + path[-1].t))]
        for before, here, after in zip(path[:-2], path[1:-1], path[2:], strict=True):
            if not (before.margin >= here.margin <= after.margin and here.margin < _REFINE_BELOW):
                continue
            for _ in range(_REFINEMENTS):
                is_first_longer = here.t - before.t > after.t - here.t
                between = evaluate(here, 0.5 * (here.t + (before.t if is_first_longer else after.t)))
                points.append(between)
                if between.margin < here.margin:
                    before, here, after = (before, between, here) if is_first_longer else (here, between, after)
                else:
                    before, after = (between, after) if is_first_longer else (before, between)
        least = points[int(np.argmin([point.margin for point in points]))]  # the first NaN, where there is one
        return least.margin, least.pair

    def _segments(self, q: Array, v: Array) -> list[tuple[Array, Array, float]]:
        """Return straight segments of the path of v and its stop: start (nq,), velocity (nv,) and duration [s] each."""
        end = self._equivalent_time(self._stopping_time(v))
        if end > self._dt and self._rows.leaves_position_limits(q, v, end):
            return self._segments_at_limits(q, v)
        return [(q, v, end)]

    def _segments_at_limits(self, q: Array, v: Array) -> list[tuple[Array, Array, float]]:
        """Return the control steps of v and of its stop, where joints near position limits have to brake harder.

        A joint that uniform slowing leaves inside its limits is never clipped along the path, because its range then
        suffices for braking all the more; so the path is straight unless its end lies outside.
        """
        x, dt = self._bounds, self._dt
        step, i, j = x.acceleration * dt, x.q_index, x.v_index
        limited = np.isfinite(step[j])
        finite_step = np.where(limited, step[j], 1.0)
        segments: list[tuple[Array, Array, float]] = []
        while len(segments) < _MAX_STOP_STEPS:
            segments.append((q, v, dt))
            q = pin.integrate(self._model, q, dt * v)
            slowing = float((np.abs(v) / step).max())
            if slowing <= 1.0:
                break
            margin = np.maximum(np.array([q[i] - x.lower, x.upper - q[i]]), 0.0)
            down, up = np.where(limited, speed_to_stop(margin, finite_step, dt), self._rate * margin)
            v_next = (1.0 - 1.0 / slowing) * v
            hardest = v[j] - step[j], v[j] + step[j]
            v_next[j] = np.clip(v_next[j], np.maximum(-down, hardest[0]), np.minimum(up, hardest[1]))
            v = v_next
        return segments

    def _equivalent_time(self, stopping_time: float) -> float:
        """Return the time for which v leads as far as v and its stop: dt Σ (1 - i dt / stopping_time), i = 0, … [s]."""
        n = stopping_time / self._dt
        m = floor(n)
        return self._dt * (1.0 + m - (0.5 * m * (m + 1) / n if m else 0.0))

    def _stopping_time(self, v: Array) -> float:
        """Return the time that the stop from v takes [s]."""
        return float((np.abs(v) / self._acceleration).max()) if self._accelerated else 0.0

    def _margin_at(self, q: Array) -> tuple[float, int]:
        """Return the least margin at q (nq,) [m], and its pair; -1 if all pairs are farther than `_MAX_MARGIN`."""
        self._kinematics.compute(q)
        query, now = self._query, self._now
        query.compute(self._kinematics.joint_poses, self._safety_distance + _MAX_MARGIN)
        pairs = query.pairs
        if not len(pairs):
            return _MAX_MARGIN, -1
        allowance = self._distance_allowance[pairs]
        later, present = query.distances_of(pairs) + allowance, now.distances_of(pairs) + allowance
        margins = query.arrays.margin
        if margins.any():
            margin = margins[query.table.twist_row[pairs]]
            later, present = later - margin, present - margin
        self._min_distance = min(self._min_distance, float(later.min()))
        required = np.minimum(self._safety_distance - TOLERANCE, present - _MAX_APPROACH_IN_VIOLATION)
        margin_of_pairs = later - required + self._allowance[pairs]
        least = int(margin_of_pairs.argmin())  # the first NaN, where there is one
        return float(margin_of_pairs[least]), int(pairs[least])
