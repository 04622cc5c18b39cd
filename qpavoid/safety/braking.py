"""Stop look-ahead: real distances along the control period of a velocity, and along the braking that would follow.

The rows of a problem are a linearisation, and they hold only pairs that are near. What is commanded must hold for the
real distances, of all pairs, at q ⊕ v dt with the obstacles of then; and it must leave room to brake. So every velocity
is followed for one control period and then slowed down uniformly, as the joint limits allow, and the distances along
that path are evaluated. Where a pair comes too near, a solution of less effort is tried, whose path is straighter; and
that is scaled towards the stop of this control step, whose path was verified one step ago. By induction a verified stop
is always available, as long as obstacles keep their velocities for one control period.

At the torque level rows keep the margins, and the look-ahead keeps off contact alone: it counts on the acceleration
that torques leave, and takes no more of the velocity away than that needs.

Most control steps need none of this: where no body moves fast enough, or not in the direction, to use up the margin of
a pair before the robot could stop, the velocity is clear (`kernels.clearance_lower_bound`, with the bound and its
proof).
"""

from __future__ import annotations

from collections.abc import Callable
from math import isnan
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.kernels import LOOKED, TOLERANCE, least_margin, speed_to_stop
from qpavoid.kernels.look_ahead import MAX_APPROACH_IN_VIOLATION, MAX_MARGIN, MIN_SPEED
from qpavoid.kernels.structures import address
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import STATE
from qpavoid.problem import Array, Problem, Solution

_MAX_STOP_STEPS = 200
"""Control steps of a braking trajectory that are followed [-]."""
_REFINE_BELOW = 2e-3
"""Margin below which the least one along a curved path is refined [m]."""
_REFINEMENTS = 6
"""Evaluations per refinement [-]: they halve the interval each."""
_REFINEMENT_ERROR = 1e-4
"""Difference of the least margins of one curved path between two control steps that counts as none [m]."""
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


class _Path(NamedTuple):
    """A path in q, straight between m + 1 points: a velocity for one control period, then its stop."""

    times: Array
    """(m + 1,) of the points, from 0 on [s]; no point of the robot moves faster than at the start."""
    travel: Array
    """(m + 1, nv) displacement from the start."""
    period_end: float
    """End of the control period [s]."""

    def displacement(self, t: float) -> Array:
        """Return the displacement (nv,) from the start at time t."""
        displacement = np.empty(self.travel.shape[1])
        kernels.write_displacement(self.times, self.travel, t, displacement)
        return displacement


class _Least(NamedTuple):
    """What came of looking along a path."""

    margin: float
    """Least margin of any pair [m]."""
    pair: int
    """That pair; -1 for none."""
    distance: float
    """Least distance of any pair, less the margins of stale obstacles [m]."""


class _PathPoint(NamedTuple):
    """A pose along a path that was evaluated."""

    t: float
    q: Array
    """(nq,)."""
    travel: Array
    """(nv,) displacement from the start of the path."""
    margin: float
    """Least of distance - required distance [m]."""
    pair: int
    distance: float
    """Least distance, less the margins of stale obstacles [m]."""


class BrakingCheck:
    """Checks velocities ahead in time, on kinematics and distances of its own."""

    def __init__(self, settings: ControlSettings, rows: RowAssembler, obstacles: ObstacleTracker) -> None:
        """Allocate all memory."""
        scene = settings.scene
        self._model, self._bounds, self._dt = scene.robot.model, settings.bounds, settings.dt
        self._safety_distance, self._rate = settings.safety_distance, settings.limits.position_gain / settings.dt
        self._rows, self._now, self._obstacles = rows, rows.query, obstacles
        self._kinematics, self._query = ForwardKinematics(self._model), DistanceQuery(scene, rows.query.table)
        self._budget = settings.budget
        self._has_accelerations = bool(np.isfinite(settings.bounds.acceleration).any())
        self._has_jerks = bool(np.isfinite(settings.bounds.jerk).any())
        self._distance_allowance = scene.distance_allowance(self._safety_distance)
        self._query.set_influence_distance(self._safety_distance + MAX_MARGIN)
        self.is_compiled = (
            self._kinematics.is_compiled
            and self._query.is_compiled
            and self._model.nq == self._model.nv
            and not (self._has_jerks or self._budget.is_limited)
        )
        """Whether kernels look along a path, but for pairs whose cores meet."""
        self.look_arguments = self._lay_out(len(scene.slots), len(scene.pairs))
        """Kernels of that, its memory, kinematics and distances."""
        self._allowance = self.look_arguments[1].allowance

    def _lay_out(self, obstacles: int, pairs: int) -> tuple[kernels.LookAheadCalls, kernels.LookAhead, Any, Any]:
        """Lay out what the kernels take, for so many obstacles and pairs."""
        query, kinematics, model = self._query.packed, self._kinematics, self._model
        memory = kernels.LookAhead(
            acceleration=self._bounds.acceleration,
            allowance=np.zeros(pairs),
            offset=self._distance_allowance,
            states=np.zeros((obstacles, STATE)),
            durations=np.full(obstacles, self._dt),
            q=np.zeros(model.nq),
            displacement=np.zeros((2, model.nv)),
            times=np.zeros(2),
            travel=np.zeros((2, model.nv)),
            result=np.zeros(3),
            dt=self._dt,
            influence_distance=self._rows.influence_distance,
            safety_distance=self._safety_distance,
            least_distance=self._safety_distance - TOLERANCE,
        )
        calls = kernels.LookAheadCalls(
            update_kinematics=address(kernels.update_kinematics, kinematics.packed, memory.q),
            place_bodies=address(kernels.place_bodies, query, kinematics.joint_poses),
            near_pairs=address(kernels.near_pairs, query, np.inf),
        )
        return calls, memory, kinematics.packed, query

    def warm_up(self, q: Array) -> None:
        """Evaluate a standstill at q (nq,), where a control step has been: no later one waits for the kernels."""
        self._least(q, np.zeros(self._model.nv))

    def check(
        self,
        q: Array,
        solution: Solution,
        problem: Problem,
        low_effort: Callable[[Problem, Array | None], Array | None],
    ) -> BrakingResult | None:
        """Return None if the path of a solution's velocity is clear, else the largest scale of it that is, or the best.

        Where the solution lets a pair come nearer on purpose, by a slack, that is allowed.

        Args:
            q: configuration (nq,).
            solution: the solver's.
            problem: the one that was solved.
            low_effort: returns another solution of less joint motion, if there is one.
        """
        v, v_stop, rows, slack = solution.v, problem.v_stop, problem.avoidance, solution.slack
        stop = self._rows.stop(q, v)
        horizon = self._dt + 0.5 * self._stopping_time(v) if stop is None else float(stop.equivalent_time.sum())
        is_uniform = horizon <= self._dt or stop is not None or not self._rows.leaves_position_limits(q, v, horizon)
        if is_uniform and self._rows.clearance_lower_bound(v, len(rows.pair), horizon, stop) > -TOLERANCE:
            return None
        self._allowance.fill(0.0)
        if slack is not None:
            self._allowance[rows.pair] = 1.1 * horizon * slack
            self._allowance[:] = self._query.max_over_group(self._allowance)
        self._query.place(self._obstacles.after(self._dt))
        least = self._least(q, v)
        if least.margin >= 0.0:
            return None
        limits_torques = problem.dynamics is not None and problem.dynamics.torque_rows > 0
        if limits_torques and least.distance >= 0.0:
            return (
                None  # d1 is kept by the rows, which see in every step what is wrong with a model, as a stop does not
            )
        best, cost = BrakingResult(v, 1.0, -least.margin, least.pair, least.distance), -least.margin
        straight = low_effort(problem, slack)
        full, scales = (v, _SCALES) if straight is None else (straight, (1.0, *_SCALES))
        for scale in scales:
            blend = v_stop + scale * (full - v_stop)
            least = self._least(q, blend)
            # a stop was clear one control step ago
            clear = -_REFINEMENT_ERROR if self._has_jerks and scale == 0.0 else 0.0
            if least.margin >= clear or (limits_torques and least.distance >= 0.0):
                return BrakingResult(blend, scale, 0.0, -1, least.distance)
            excess = rows.b - rows.J @ blend - (0.0 if slack is None else slack)
            tried = _VIOLATION_TIME * float(np.max(excess, initial=0.0)) - least.margin
            if tried < cost:
                best, cost = BrakingResult(blend, scale, -least.margin, least.pair, least.distance), tried
        return best

    def _least(self, q: Array, v: Array) -> _Least:
        """Return the least margin along the path of v (nv,) and its stop, with the least distance of all.

        Steps are such that no two bodies can meet in between, and no shorter than `_MIN_STEP`: the approach of a pair
        within one of those is of second order in it, as it was not too near at either end. A curved path may turn back
        in between, and before its end: there the least margin is refined.
        """
        path, now = self._path(q, v), self._now
        if self.is_compiled:
            calls, look, kinematics, later = self.look_arguments
            if kernels.look_along(calls, look, now.packed, kinematics, later, q, path.times, path.travel) == LOOKED:
                margin, pair, distance = look.result.tolist()
                return _Least(margin, int(pair), distance)
        speed = max(float(now.arrays.speeds.max()), MIN_SPEED)
        nearest = float(np.min(now.distances_of(now.pairs), initial=self._rows.influence_distance))
        nearest -= float(np.max(now.arrays.margin, initial=0.0))
        points = [_PathPoint(0.0, q, path.travel[0], nearest - self._safety_distance, -1, np.inf)]
        end = float(path.times[-1])
        while (t := points[-1].t) < end and (len(points) == 1 or not isnan(points[-1].margin)):
            t = kernels.next_pose_time(t, points[-1].margin, len(points), end, path.period_end, speed)
            points.append(self._evaluate(path, points[-1], t))
        evaluated = points[1:]
        if self._has_jerks:
            evaluated = [*evaluated, self._evaluate(path, points[-2], 0.5 * (points[-2].t + points[-1].t))]
            for previous, here, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
                if previous.margin >= here.margin <= after.margin and here.margin < _REFINE_BELOW:
                    evaluated += self._refine(path, previous, here, after)
        least = evaluated[int(np.argmin([point.margin for point in evaluated]))]  # the first NaN, where there is one
        return _Least(least.margin, least.pair, min(point.distance for point in evaluated))

    def _refine(self, path: _Path, previous: _PathPoint, here: _PathPoint, after: _PathPoint) -> list[_PathPoint]:
        """Return points around the least margin between two points."""
        evaluated = []
        for _ in range(_REFINEMENTS):
            is_first_longer = here.t - previous.t > after.t - here.t
            between = self._evaluate(path, here, 0.5 * (here.t + (previous.t if is_first_longer else after.t)))
            evaluated.append(between)
            if between.margin < here.margin:
                previous, here, after = (previous, between, here) if is_first_longer else (here, between, after)
            else:
                previous, after = (between, after) if is_first_longer else (previous, between)
        return evaluated

    def _path(self, q: Array, v: Array) -> _Path:
        """Return the path of v (nv,) and its stop: curved under jerk limits, else straight up to position limits."""
        stop = self._rows.stop(q, v)
        if stop is not None:
            speed = max(float(self._now.arrays.speeds.max()), MIN_SPEED)
            durations = np.maximum(stop.equivalent_time + stop.lateral_bound / speed, 1e-9)
            return _joined(durations, self._dt * stop.velocities, float(durations[0]))
        duration = kernels.stop_duration(v, self._bounds.acceleration, self._dt)
        if duration > self._dt and self._rows.leaves_position_limits(q, v, duration):
            steps = self._dt * self._steps_at_limits(q, v)
            return _joined(np.full(len(steps), self._dt), steps, self._dt)
        return _joined(np.array([duration]), duration * v[None], self._dt)

    def _steps_at_limits(self, q: Array, v: Array) -> Array:
        """Return the velocities (m, nv) of v and of its stop, where joints near position limits have to brake harder.

        A joint that uniform slowing leaves inside its limits is never clipped along the path, because its range then
        suffices for braking all the more; so the path is straight unless its end lies outside.
        """
        x, dt = self._bounds, self._dt
        step, i, j = x.acceleration * dt, x.q_index, x.v_index
        limited = np.isfinite(step[j])
        finite_step = np.where(limited, step[j], 1.0)
        velocities = [v]
        while len(velocities) < _MAX_STOP_STEPS and (slowing := float((np.abs(v) / step).max())) > 1.0:
            q = pin.integrate(self._model, q, dt * v)
            margin = np.maximum(np.array([q[i] - x.lower, x.upper - q[i]]), 0.0)
            down, up = np.where(limited, speed_to_stop(margin, finite_step, dt), self._rate * margin)
            hardest = v[j] - step[j], v[j] + step[j]
            v = (1.0 - 1.0 / slowing) * v
            v[j] = np.clip(v[j], np.maximum(-down, hardest[0]), np.minimum(up, hardest[1]))
            velocities.append(v)
        return np.array(velocities)

    def _stopping_time(self, v: Array) -> float:
        """Return the time that the stop from v takes [s]."""
        return float((np.abs(v) / self._bounds.acceleration).max()) if self._has_accelerations else 0.0

    def _evaluate(self, path: _Path, previous: _PathPoint, t: float) -> _PathPoint:
        """Evaluate the pose at time t, integrated from that of another point; pair -1 if none is near."""
        self._budget.check("stop look-ahead")
        travel = path.displacement(t)
        q = pin.integrate(self._model, previous.q, travel - previous.travel)
        self._kinematics.compute(q)
        query, now = self._query, self._now
        query.compute(self._kinematics.joint_poses, self._safety_distance + MAX_MARGIN)
        pairs = query.pairs
        margin, pair, distance = least_margin(
            pairs, query.distances_of(pairs), now.distances_of(pairs), self._distance_allowance, self._allowance,
            query.table.twist_row, query.arrays.margin, self._safety_distance - TOLERANCE, MAX_APPROACH_IN_VIOLATION,
        )  # fmt: skip
        return _PathPoint(t, q, travel, margin if pair >= 0 else MAX_MARGIN, pair, distance)


def _joined(durations: Array, steps: Array, period_end: float) -> _Path:
    """Return the path of straight steps (m, nv) of some durations (m,) [s]."""
    times = np.concatenate(([0.0], np.cumsum(durations)))
    return _Path(times, np.concatenate((np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0))), period_end)
