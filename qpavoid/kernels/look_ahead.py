"""Stop look-ahead in compiled code: the least margin of all pairs along a path of the robot, see `safety.braking`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.margins import distances_of, least_margin
from qpavoid.kernels.packing import compiled, exact
from qpavoid.kernels.structures import call, call_for_three_counts
from qpavoid.problem import Array

MAX_MARGIN = 0.04
"""Distance beyond the safety distance up to which pairs are evaluated [m]: larger margins only set longer steps."""
MIN_SPEED = 1e-3
"""Least speed by which steps along a path are scaled [m/s]."""
MAX_APPROACH_IN_VIOLATION = 1e-5
"""Approach per control step that a pair below its safety distance may make [m]: round-off of the row that parts it."""
_MIN_STEP = 5e-3
"""Least motion of the fastest point between two poses that are evaluated [m]; bounds their number."""
_MAX_POSES = 48
"""Poses that are evaluated along one path, about [-]; bounds the time of a control step."""
LOOKED, TO_LOOK = range(2)
"""What `look_along` returns: the result is written; the distances of a pose have to be computed by other means."""


class LookAheadCalls(NamedTuple):
    """Addresses of kernels, see `kernels.structures`."""

    update_kinematics: Any
    place_bodies: Any
    near_pairs: Any


class LookAhead(NamedTuple):
    """Memory of the look-ahead of a robot whose configurations add up."""

    acceleration: Array
    """(nv,) limits, infinite where there is none [rad/s² or m/s²]."""
    allowance: Array
    """(m,) by which each pair may come nearer on purpose [m]."""
    offset: Array
    """(m,) added to the distances of each pair [m]."""
    states: Array
    """(o, 18) of the obstacles at the end of the control period."""
    durations: Array
    """(o,) the control period, for each of them [s]."""
    q: Array
    """(nq,) pose that is evaluated."""
    displacement: Array
    """(2, nv) of the pose before from the start, and of that one."""
    times: Array
    """(2,) of the ends of a straight path, the first one 0 [s]."""
    travel: Array
    """(2, nv) displacements of these."""
    result: Array
    """(3,) out: least margin [m], number of its pair, -1 for none, and least distance of any pair [m]."""
    dt: float
    """Control period [s]."""
    influence_distance: float
    """Surface distance below which a pair is near in the control step [m]."""
    safety_distance: float
    """d1, at the level of the rows [m]."""
    least_distance: float
    """That is required of pairs, a little less [m]."""


@exact
def stop_duration(v: Array, acceleration: Array, dt: float) -> float:
    """Compute the time in which v (nv,) leads as far as one control period of it and the stop that follows [s].

    Args:
        v: velocity.
        acceleration: limits (nv,), infinite where there is none.
        dt: control period [s].
    """
    time = 0.0
    for j in range(len(v)):
        time = max(time, abs(v[j]) / acceleration[j])
    n = time / dt
    m = np.floor(n)  # dt Σ (1 - i/n), i = 0, …, m
    return dt * (1.0 + m - (0.5 * m * (m + 1.0) / n if m > 0.0 else 0.0))


@exact
def write_straight_path(s: LookAhead, v: Array, duration: float) -> None:
    """Write the path of v (nv,) until `duration` [s]."""
    s.times[1] = duration
    for j in range(len(v)):
        s.travel[1, j] = duration * v[j]


@exact
def next_pose_time(t: float, margin: float, count: int, end: float, period_end: float, speed: float) -> float:
    """Return the time of the pose to evaluate after another one [s].

    No two bodies can meet in between, unless that is shorter than `_MIN_STEP`. The end of the control period is always
    evaluated, and the last of all poses is the end.

    Args:
        t: time of the pose before [s].
        margin: least margin there [m].
        count: poses until then, with the start.
        end: of the path [s].
        period_end: of the control period [s].
        speed: largest one of any point [m/s].
    """
    left, last = _MAX_POSES - count, period_end if count == 1 else end
    step = max(0.5 * min(max(margin, 0.0), MAX_MARGIN), _MIN_STEP) / speed
    step = max(step, (end - t) / max(left, 1))
    return last if left <= 1 else min(t + step, last)


@exact
def write_displacement(times: Array, travel: Array, t: float, displacement: Array) -> None:
    """Write the displacement (nv,) from the start of a path at time t [s].

    Args:
        times: of its m + 1 points, from 0 on [s].
        travel: displacements of these (m + 1, nv).
        t: time [s].
        displacement: out.
    """
    k, last = 1, len(times) - 1
    while k < last and times[k] <= t:
        k += 1
    left = (times[k] - t) / (times[k] - times[k - 1])
    for j in range(len(displacement)):
        displacement[j] = travel[k, j] - left * (travel[k, j] - travel[k - 1, j])


@exact
def first_margin(now: Any, influence_distance: float, safety_distance: float) -> float:
    """Bound the margin of all pairs in a control step from below [m], by its distances `now`."""
    nearest, widest = influence_distance, 0.0
    for k in now.rows[: now.counts[1]]:
        nearest = np.minimum(nearest, now.results[k, 0])  # keeps NaN, unlike min
    for i in range(len(now.margin)):
        widest = max(widest, now.margin[i])
    return float(nearest - widest - safety_distance)


@compiled
def fastest_speed(now: Any) -> float:
    """Return the largest speed of any point in a control step with the distances `now`, `MIN_SPEED` at least [m/s]."""
    speed = MIN_SPEED
    for i in range(len(now.speeds)):
        speed = max(speed, now.speeds[i])
    return speed


@exact
def look_along(
    calls: LookAheadCalls, s: LookAhead, now: Any, kinematics: Any, later: Any, q: Array, times: Array, travel: Array
) -> int:
    """Write the least margin along a path, with the obstacles as they are placed in `later`.

    Args:
        calls: kernels.
        s: memory; writes q, displacement and result.
        now: distances of the control step, see `DistanceArrays`, with the speeds of this path.
        kinematics: of the look-ahead, see `KinematicsArrays`.
        later: distances of the look-ahead.
        q: configuration at the start (nq,).
        times: of the points of the path (m + 1,), the first one 0 [s].
        travel: displacements of these (m + 1, nv).

    Returns:
        LOOKED or TO_LOOK.
    """
    t, end, count = 0.0, times[-1], 1
    margin, speed = first_margin(now, s.influence_distance, s.safety_distance), fastest_speed(now)
    s.q[:], s.displacement[:] = q, 0.0
    least, pair, distance = np.inf, -1, np.inf
    while t < end and (count == 1 or margin == margin):
        t = next_pose_time(t, margin, count, end, s.dt, speed)
        write_displacement(times, travel, t, s.displacement[1])
        for j in range(len(s.q)):
            s.q[j] += s.displacement[1, j] - s.displacement[0, j]
            s.displacement[0, j] = s.displacement[1, j]
        call(calls.update_kinematics, (kinematics, s.q))
        call(calls.place_bodies, (later, kinematics.joint_poses))
        _, rows, meeting = call_for_three_counts(calls.near_pairs, (later, np.inf))
        if meeting > 0:
            return TO_LOOK
        pairs = later.rows[:rows]
        margin, nearest_pair, nearest = least_margin(
            pairs, distances_of(later.near[: later.counts[0]], later.results, pairs),
            distances_of(now.near[: now.counts[0]], now.results, pairs), s.offset, s.allowance, later.twist_row,
            later.margin, s.least_distance, MAX_APPROACH_IN_VIOLATION,
        )  # fmt: skip
        margin = margin if nearest_pair >= 0 else MAX_MARGIN
        if margin < least or (margin != margin and least == least):  # the first NaN, where there is one
            least, pair = margin, nearest_pair
        distance, count = np.minimum(distance, nearest), count + 1
    s.result[0], s.result[1], s.result[2] = least, pair, distance
    return LOOKED
