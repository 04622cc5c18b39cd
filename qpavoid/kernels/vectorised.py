"""Array work of a tick in numpy: no Python loop over pairs, few calls, each on small arrays.

`qpavoid.kernels.compiled` has the same functions as loops for numba; both pass the same tests.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from qpavoid.kernels.layout import RowLayout
from qpavoid.kernels.stopping import AT_REST, MOST_STEPS, longest_way, way_to_stop
from qpavoid.kernels.workspace import Rows, Workspace
from qpavoid.problem import Array, IntArray

BRAKING_SHARE = 0.5
"""Share of the joints' accelerations on which a pair counts for braking; other pairs want some, too [-]."""
WELL_CONDITIONED = 1e-6
"""Ratio of the smallest to the largest pivot of J Jᵀ down to which J⁺ is taken from it without damping."""

_SWAPPED, _DOUBLED = np.array([0, 1, 2, 4, 3]), np.array([2.0, 2.0, 2.0, 1.0, 1.0])
_CYCLE = np.array([1, 2, 0, 2, 0, 1])
_ANTICYCLE = np.array([2, 0, 1, 1, 2, 0])
_SKEW = np.zeros((3, 9))
_SKEW[2, [1, 3]] = 1.0, -1.0
_SKEW[1, [2, 6]] = -1.0, 1.0
_SKEW[0, [5, 7]] = 1.0, -1.0


def pack(layout: RowLayout) -> Workspace:
    """The layout in the form that the kernels take."""
    return Workspace(layout)


def candidates(poses: Array, local: Array, centers: Array, within: Array, pair_of: IntArray, found: IntArray) -> int:
    """Pairs whose bounding spheres are within reach of each other.

    Args:
        poses: world poses of all geometries, rotation by columns and translation (g, 12).
        local: centres of their bounding spheres in their own frames (g, 3) [m].
        centers: the same in the world, as rows [c, 1, -|c|²] (g, 5) [m]; those of the b bodies of the robot, which
            come first, are overwritten.
        within: squared distance of centres up to which each combination counts (b, g) [m²]; negative where there is no
            pair.
        pair_of: index of the pair of each combination (b, g), increasing along the rows, one after the other.
        found: overwritten with the indices of these pairs, increasing (m,).

    Returns:
        How many there are.
    """
    bodies = len(pair_of)
    body = centers[:bodies]
    body[:, :3] = np.matmul(local[:bodies, None], poses[:bodies, :9].reshape(-1, 3, 3))[:, 0] + poses[:bodies, 9:]
    np.einsum("ij,ij->i", body[:, :3], -body[:, :3], out=body[:, 4])
    # 2 a·c - |a|² - |c|² >= -within, the left side as one matrix product
    pairs = pair_of[np.dot(body[:, _SWAPPED] * _DOUBLED, centers.T) + within >= 0.0]
    found[: len(pairs)] = pairs
    return len(pairs)


def assemble(x: Any, q: Array, pairs: IntArray, reach: float, moving: bool) -> tuple[int, float]:
    """All rows and bounds of a tick, and the tracking law's velocity.

    Args:
        x: memory of the tick; its outputs are overwritten.
        q: configuration (nq,).
        pairs: those whose results are of this tick (c,), increasing.
        reach: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.

    Returns:
        Number k of near pairs; by how much the tracking law's velocity violates the worst of rows and bounds
        (negative inside, NaN where there is one).
    """
    frame_rows(x)
    velocity_bounds(x, q)
    stop_velocity(x)
    damped_solution(x, x.v0)
    k = distance_rows(x, pairs, reach, moving)
    if k:
        row_bounds(x, k, moving)
    return k, tracking_shortfall(x, k)


def distance_rows(x: Any, pairs: IntArray, reach: float, moving: bool) -> int:
    """Closest points and rates of the pairs that are nearer than `reach`, or whose distance is NaN.

    The normal n is parallel to the line between the witness points, so p × n is the same at both, and every row is
    J = [n, p × n]ᵀ J_world, masked with the difference of the supports of the two bodies.

    Args:
        x: reads results, J_world, support, twists, twist_row; writes near, closest, J, drift.
        pairs: which pairs to look at (c,), increasing.
        reach: distance below which a pair is near [m].
        moving: whether any of the twists is not zero.

    Returns:
        How many are near.
    """
    results = x.results
    distance = results[:, 0] if len(pairs) == len(results) else results[pairs, 0]
    near = pairs[~(distance >= reach)]  # a NaN is near, not hidden
    k = len(near)
    if not k:
        return 0
    rows = x.rows(k)
    rows.near[:] = near
    results.take(near, axis=0, out=rows.closest, mode="clip")
    rows.linear[:] = rows.normal
    products = rows.point[_CYCLE]
    products *= rows.normal[_ANTICYCLE]
    np.subtract(products[:3], products[3:], out=rows.angular)
    if x.mimics:
        np.dot(np.dot(rows.screw_rows, x.J_world) * x.support[near], x.fold, out=rows.J)
    else:
        J = rows.J
        np.dot(rows.screw_rows, x.J_world, out=J)
        J *= x.support.take(near, axis=0, mode="clip")
    if moving:
        np.einsum("ij,ji->i", x.twists[x.twist_row[near]], rows.screws, out=rows.drift)
    elif x.was_moving:
        x.drift.fill(0.0)
    x.was_moving = moving
    return k


def row_bounds(x: Any, k: int, moving: bool) -> None:
    """Right-hand sides of the first k avoidance rows: see `qpavoid.avoidance`; writes d, least and touch.

    With acceleration limits, a pair closes no faster than the speed from which a share of its joints' accelerations,
    all at work on it, brings it to rest in what is left: ½ a dt - √((½ a dt)² + 2 a h).

    A row never asks for more than can be had: of a pair that may still close, and whose obstacle does not come nearer,
    no more than a stop gives, so that the stop meets all such rows at once; of one that has to part, no more speed of
    parting than the bounds allow, and where they do not allow any yet, no harder braking.
    """
    rows = x.rows(k)
    d, least, touch, share, drift = rows.d, rows.least, rows.touch, rows.share, rows.drift
    np.add(rows.distance, x.offset_, out=d)
    if moving:
        d -= x.margin[x.twist_row[rows.near]]
    np.subtract(x.hold_, d, out=least)
    parting = least > x.zero
    some = np.count_nonzero(parting) > 0
    if x.switching:
        np.subtract(d, x.d1_, out=share)
        share *= x.blend
        if some:
            np.maximum(share, x.zero, out=share)
        np.minimum(share, x.quarter, out=share)
        np.sin(share, out=share)
        share *= share
        share *= least
        # 1 - β = sin² is 0 below d1, where the row asks for recovery instead, which β does not weaken
        if some:
            np.maximum(least, x.zero, out=rows.beyond)
            np.add(share, rows.beyond, out=least)
            least *= x.gain_
        else:
            np.multiply(share, x.gain_, out=least)
    else:
        least *= x.gain_
    if x.accelerated:
        _leave_room_to_brake(x, rows)
    if some or x.jerked:
        np.minimum(least, x.recovery_, out=least)
    if moving:
        least -= drift
    if x.accelerated:
        np.minimum(least, np.dot(rows.J, x.v_stop), out=least, where=~parting & (drift >= 0.0))
    if some:
        with np.errstate(invalid="ignore"):  # no lever times no limit
            most = np.nansum(np.fmax(rows.J * x.lower, rows.J * x.upper), axis=1)
        np.maximum(most, -drift, out=most, where=drift < 0.0)
        np.minimum(least, most, out=least, where=parting)
    np.subtract(x.offset_, d, out=touch)
    touch *= x.gain_
    if moving:
        touch -= drift
    np.minimum(touch, least, out=touch)


def _leave_room_to_brake(x: Any, rows: Rows) -> None:
    with np.errstate(invalid="ignore"):  # no lever times no limit
        braking = 0.5 * BRAKING_SHARE * np.nansum(np.abs(rows.J) * x.v_step, axis=1)
        room = np.maximum(rows.d - x.hold, 0.0) / x.dt
        fastest = braking - np.sqrt(braking * braking + 4.0 * braking * room)
    closing = (rows.least < 0.0) & np.isfinite(braking)
    np.maximum(rows.least, fastest, out=rows.least, where=closing)
    if x.jerked:
        _room_for_jerk(x, rows, np.flatnonzero(closing), 2.0 * braking, room)


def _room_for_jerk(x: Any, rows: Rows, closing: IntArray, step: Array, room: Array) -> None:
    """Raises the bounds of closing pairs to the speeds from which a share of their joints' jerks, too, brings them to
    rest in time, at the change of speed that has led to them (`kernels.stopping`).

    Args:
        x: memory of the tick.
        rows: of the near pairs (k,).
        closing: which of them close (c,).
        step: change of the speed of closing that a share of the joints' accelerations makes in a tick (k,) [m/s].
        room: distance left over the length of a tick (k,) [m/s].
    """
    J = rows.J[closing]
    with np.errstate(invalid="ignore"):  # no lever times no limit
        unit = BRAKING_SHARE * np.nansum(np.abs(J) * x.w_step, axis=1)
    known = (unit > 0.0) & (unit < np.inf)
    closing, J, unit = closing[known], J[known], unit[known]
    speed, change = -np.dot(J, x.v_last) - rows.drift[closing], -np.dot(J, x.w_last)
    # all jerks at work on a pair change the change of its speed no more than this
    high = np.minimum((-rows.least[closing] - speed) / unit, change / unit + 1.0 / BRAKING_SHARE)
    change = change_to_stop(speed / unit, high, step[closing] / unit, room[closing] / unit)
    rows.least[closing] = np.maximum(rows.least[closing], -speed - unit * change)


def closest_call(x: Any, v: Array, k: int, reach: float, horizon: float) -> float:
    """A bound below what is left of the safe distance of every pair on the straight way of v until `horizon`.

    No distance falls faster than the fastest points of its two bodies move. A point that a joint carries moves at most
    at the speed of the joint's origin plus its angular speed times the distance. It comes at most s h + ½ a h² far in
    the time h, if it starts at speed s and its acceleration stays below a; at constant joint rates that is at most
    Ω² R + 2 Ω V, with the sums Ω of the angular and V of the linear rates of the joints that carry it and the longest
    lever R.

    Args:
        x: reads what the tick found, and joint_velocities; writes the speeds of the joints.
        v: velocity (n,), that of joint_velocities.
        k: number of near pairs.
        reach: surface distance below which a pair is near; all others are at least so far apart [m].
        horizon: h [s].

    Returns:
        Least of distance - hold [m] on the way, or less; NaN where there is one.
    """
    rates = np.abs(v)
    turning = max(np.dot(x.turning, rates).tolist())  # of a few numbers, Python's max is the quicker one
    sliding = max(np.dot(x.sliding, rates).tolist()) if x.slides else 0.0
    bend = horizon * horizon * turning * (turning * x.lever + 2.0 * sliding)  # of both bodies: twice ½ a h²
    np.multiply(x.joint_velocities, x.joint_velocities, out=x.squares)
    np.dot(x.squares, x.by_kind, out=x.linear_angular)
    np.sqrt(x.linear_angular, out=x.linear_angular)
    np.multiply(x.angular_speed, x.joint_reach, out=x.joint_speeds)
    x.joint_speeds += x.linear_speed
    speeds = x.speeds.tolist()
    fastest, known = max(speeds[: x.joints]), sum(speeds)
    least = reach + x.offset - x.hold - (fastest + max(speeds)) * horizon - bend
    if k:
        rows = x.rows(k)
        closing = x.speeds.take(x.carriers.take(rows.near, axis=0, mode="clip"), mode="clip")
        ways = rows.share
        np.add(closing[:, 0], closing[:, 1], out=ways)
        ways *= horizon
        np.subtract(rows.d, ways, out=ways)
        left = float(ways.min()) - x.hold - bend
        least = min(least, left) if left == left else left
    return float(least) if known == known else math.nan


def rotation_vector(R: Any) -> tuple[float, float, float]:
    """Rotation vector [rad] of a rotation R[i][j], with an angle up to and including π.

    By way of the quaternion, whose largest component is taken first, so that nothing is lost near half a turn.
    """
    trace = R[0][0] + R[1][1] + R[2][2]
    if trace >= max(R[0][0], R[1][1], R[2][2]):
        w, x, y, z = 1.0 + trace, R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]
    elif R[0][0] >= max(R[1][1], R[2][2]):
        w, x, y, z = R[2][1] - R[1][2], 1.0 + 2.0 * R[0][0] - trace, R[0][1] + R[1][0], R[0][2] + R[2][0]
    elif R[1][1] >= R[2][2]:
        w, x, y, z = R[0][2] - R[2][0], R[0][1] + R[1][0], 1.0 + 2.0 * R[1][1] - trace, R[1][2] + R[2][1]
    else:
        w, x, y, z = R[1][0] - R[0][1], R[0][2] + R[2][0], R[1][2] + R[2][1], 1.0 + 2.0 * R[2][2] - trace
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-12:
        return 0.5 * x, 0.5 * y, 0.5 * z
    scale = (2.0 if w >= 0.0 else -2.0) * math.atan2(length, abs(w)) / length
    return scale * x, scale * y, scale * z


def frame_rows(x: Any) -> None:
    """Rows A v = b of f frames that follow targets: feed-forward plus gain times what is missing, capped and scaled.

    The orientation error is the rotation vector of R_target Rᵀ. Three linear rows for each frame whose position counts
    come first, then three angular rows for each whose orientation does; rows after these are left as they are.

    Args:
        x: reads frame_poses, targets and the layout of the tasks; writes poses, A, b.
    """
    x.frame_poses.take(x.frame_ids, axis=0, out=x.poses, mode="clip")
    here, turns, wanted = x.here, x.turns, x.wanted
    x.moments[:] = np.dot(here, _SKEW).reshape(-1, 3, 3)
    np.subtract(x.position, here, out=wanted)
    wanted *= x.moving_gain
    wanted += x.linear
    if len(turns):
        # poses hold rotations by columns, so these are their transposes
        missing = (x.rotation @ x.turned).tolist()
        if x.every_turns:
            x.wanted_turns[:] = [rotation_vector(R) for R in missing]
            x.wanted_turns *= x.gain_column
            x.wanted_turns += x.angular
        else:
            x.wanted_turns[:] = [rotation_vector(missing[f]) for f in turns]
            x.wanted_turns *= x.gain_column[turns]
            x.wanted_turns += x.angular[turns]
    if x.capped:
        asked = x.asked
        asked *= np.minimum(x.cap / np.maximum(np.sqrt((asked * asked).sum(axis=1)), 1e-12), 1.0)[:, None]
    if x.mimics:
        np.dot(np.dot(x.screws, x.J_world) * x.task_support, x.fold, out=x.A_frames)
    else:
        np.dot(x.screws, x.J_world, out=x.A_frames)
        np.multiply(x.A_frames, x.task_support, out=x.A_frames)
    np.multiply(x.b_frames, x.scale, out=x.b_frames)


def speed_to_stop(room: Array, step: Array | float, dt: float) -> Array:
    """Largest speed from which a coordinate that is slowed by `step` in every tick comes to rest within `room`.

    From v it still goes S(v) = dt Σ max(v - i step, 0), i = 0, 1, …; on (n - 1) step <= v <= n step that is
    n dt v - dt step n (n - 1) / 2, and S(n step) = dt step n (n + 1) / 2, which gives the number of ticks n. Once it
    moves at such a speed, slowing down by `step` keeps to it, so that the bounds of the next tick never contradict.

    Args:
        room: distance left (...), not negative; infinite where there is no limit [rad or m].
        step: change of speed in one tick (...), positive [rad/s or m/s].
        dt: length of a tick [s].
    """
    ticks = np.clip(np.ceil(0.5 * np.sqrt(1.0 + 8.0 * room / (step * dt)) - 0.5), 1.0, 1e15)
    return np.asarray(room / (dt * ticks) + 0.5 * step * (ticks - 1.0))


def change_to_stop(speed: Array, high: Array, most: Array, room: Array) -> Array:
    """Largest change of v, no larger than `high`, after which a stop within the limits ends within `room`.

    Newton's method from above, on the convex way of `kernels.stopping.way_to_stop`, with its units. -∞ where not even
    a coordinate that comes to rest at once would do.

    Args:
        speed: v (n,).
        high: largest change that matters (n,).
        most: largest that the acceleration allows (n,).
        room: way that is left (n,), not negative.
    """
    change = high.copy()
    left = np.flatnonzero(longest_way(speed + high, high, most) > room)
    for _ in range(MOST_STEPS):
        way, growth = way_to_stop(speed[left] + change[left], change[left], most[left])
        over = way > room[left]
        left = left[over]
        if not len(left):
            break
        change[left] -= (way[over] - room[left]) / growth[over]
    return np.asarray(change)


def velocity_bounds(x: Any, q: Array) -> None:
    """Bounds on v from the joint limits: see `qpavoid.limits`; writes hard_lower, hard_upper, lower and upper."""
    room = x.room  # [lower, upper]: how far the coordinate is above its lower limit, and below the upper one
    np.subtract(x.q_limits, q if x.plain else q[x.q_index], out=room)
    if x.accelerated:
        room[0] *= -1.0
        step = x.limited_step
        if x.jerked:
            left = np.array(room)
            step = np.minimum(step, x.limited_jerk - x.signs * x.w_last[x.v_index])
        slowed = np.maximum(x.rate_ * room, x.signs * x.v_last[x.v_index] - step)
        stop = speed_to_stop(np.maximum(room, 0.0), x.finite_step, x.dt)
        speed = np.where(np.isinf(x.limited_step), x.rate_ * room, np.where(room > 0.0, stop, slowed))
        # on the way back from outside one limit it can still brake for the other
        np.maximum(speed, -speed[::-1], out=speed, where=room < 0.0)
        room[:] = speed
        room[0] *= -1.0
    else:
        room *= x.rate_
    np.minimum(room, x.fastest, out=room)
    if x.plain:
        np.maximum(room[0], x.slowest, out=x.hard_lower)
        np.maximum(room[1], x.slowest, out=x.hard_upper)
    else:
        np.maximum(room, x.slowest, out=room)
        x.hard_lower[:], x.hard_upper[:] = x.v_min, x.v_max
        x.hard_lower[x.v_index], x.hard_upper[x.v_index] = room
    if x.jerked:
        lower, upper = _within_jerk(x, left)
    if x.accelerated:
        np.clip(x.v_last - x.v_step, x.hard_lower, x.hard_upper, out=x.lower)
        np.clip(x.v_last + x.v_step, x.hard_lower, x.hard_upper, out=x.upper)
    if x.jerked:
        within = np.clip(lower, x.lower, x.upper), np.clip(upper, x.lower, x.upper)
        x.lower[:], x.upper[:] = within


def _within_jerk(x: Any, room: Array) -> tuple[Array, Array]:
    """Bounds (n,) on v between which the stops of `kernels.stopping` end within position and velocity limits.

    They never cross, as the stop's own next velocity is between them from any state. Of a coordinate outside its
    limits, the hard bounds that send it back give way to what it needs to stop before the opposite limit.

    Args:
        x: memory of the tick.
        room: how far coordinates are from their position limits (2, l).
    """
    unit, most, j = x.jerk_unit, x.jerk_most, x.jerk_index
    speed, change = x.v_last[j] / unit, x.w_last[j] / unit
    target = np.copysign(np.minimum(speed_to_stop(np.abs(speed), 1.0, 1.0), most), -speed)
    stop = np.minimum(np.maximum(target, change - 1.0), change + 1.0)
    speed, change, stop = x.signs * speed, x.signs * change, x.signs * stop
    left, bounds = np.full((2, len(x.v_max)), np.inf), np.repeat(np.inf * x.signs, len(x.v_max), axis=1)
    left[:, x.v_index] = room
    left = left[:, j] / (x.dt * unit)
    fastest = np.where(left >= 0.0, x.jerk_fastest, 0.0)  # once on its way back, a coordinate does not turn round again
    high = np.minimum(np.minimum(change + 1.0, most), speed_to_stop(np.maximum(fastest - speed, 0.0), 1.0, 1.0))
    found = change_to_stop(speed.ravel(), high.ravel(), np.tile(most, 2), np.maximum(left, 0.0).ravel())
    bounds[:, j] = x.v_last[j] + x.signs * unit * np.maximum(found.reshape(2, -1), stop)
    lower, upper = bounds
    beyond, below = x.v_index[room[1] < 0.0], x.v_index[room[0] < 0.0]
    x.hard_upper[beyond] = np.maximum(x.hard_upper[beyond], np.minimum(lower, x.v_max)[beyond])
    x.hard_lower[below] = np.minimum(x.hard_lower[below], np.maximum(upper, -x.v_max)[below])
    return lower, upper


def stop_velocity(x: Any) -> None:
    """Slows v_last down by one factor for all coordinates, so that no distance closes faster; writes v_stop.

    Bounds of position and velocity come first. Without acceleration limits it is a standstill, if they allow that.
    With jerk limits, the change of v goes straight towards that of the stop that would be the fastest of all with one
    factor, in steps that no coordinate's jerk forbids; once it is there, it stays there to the end.
    """
    if x.jerked:
        np.clip(easing_stop(x, x.v_last, x.w_last), x.lower, x.upper, out=x.v_stop)
    elif x.accelerated:
        slowing = np.max(np.abs(x.v_last) / x.v_step, initial=1.0)  # number of ticks to a standstill
        np.clip((1.0 - 1.0 / slowing) * x.v_last, x.lower, x.upper, out=x.v_stop)
    else:
        np.minimum(x.upper, x.zero, out=x.v_stop)
        np.maximum(x.v_stop, x.lower, out=x.v_stop)


def easing_stop(x: Any, v: Array, w: Array) -> Array:
    """Next velocity (n,) of a stop within jerk limits: see `stop_velocity`.

    Args:
        x: reads v_step and w_step.
        v: velocity (n,).
        w: by how much it has just changed (n,).
    """
    speeds = np.abs(v)
    braking, fastest = 1.0 / max(float((speeds / x.v_step).max()), 1.0), float((speeds / x.w_step).max())
    if fastest > 0.0:
        ticks = max(math.ceil(0.5 * math.sqrt(1.0 + 8.0 * fastest) - 0.5), 1)
        braking = min(braking, 1.0 / ticks + 0.5 * (ticks - 1) / fastest)  # σ(fastest) / fastest
    kept = 1.0 - 1.0 / max(float((np.abs(w + braking * v) / x.w_step).max()), 1.0)
    return (1.0 - (1.0 - kept) * braking) * v + kept * w


def stop_way(x: Any, q: Array, w: Array, way: Array) -> int:
    """Velocities of the ticks of a stop within jerk limits, from the velocity way[0] on.

    Bounds are looked at only where the stop without them may come near a limit of position or velocity.

    Args:
        x: memory of its own; the limits are read.
        q: configuration (nq,) before the first of these ticks.
        w: change of v that has led to way[0] (n,), no larger than v_step.
        way: out, room for as many ticks as are looked at (m, n).

    Returns:
        Number of ticks in which the robot moves, or m.
    """
    count = _stop_ticks(x, q, w, way, False)
    return count if _free(x, q, way[:count]) else _stop_ticks(x, q.copy(), w, way, True)


def _free(x: Any, q: Array, way: Array) -> bool:
    """Whether the velocities (m, n) of a stop that began at q are surely within the bounds of their ticks."""
    unlimited, i, j = np.isinf(x.w_step), x.jerk_index, x.v_index
    speed, change = way[1:, i] / x.jerk_unit, np.diff(way[:, i], axis=0) / x.jerk_unit
    if np.isfinite(x.v_max[unlimited]).any() or unlimited[j].any():
        return False
    if (np.abs(speed) + 0.5 * change * change > x.jerk_fastest * (1.0 + AT_REST)).any():
        return False
    places = q[x.q_index] + x.dt * np.cumsum(way[:-1, j], axis=0)
    unit, most = x.limited_jerk, x.v_step[j] / x.limited_jerk
    speed, change = way[1:, j] / unit, np.diff(way[:, j], axis=0) / unit
    far = longest_way(speed, change, most) <= (x.q_upper - places) / (x.dt * unit)
    return bool((far & (longest_way(-speed, -change, most) <= (places - x.q_lower) / (x.dt * unit))).all())


def _stop_ticks(x: Any, q: Array, w: Array, way: Array, bounded: bool) -> int:
    """`stop_way`, with all bounds at all places of the way, or with none."""
    v = way[0]
    for k in range(1, len(way)):
        if bounded:
            x.v_last[:], x.w_last[:] = v, w
            q[x.q_index] += x.dt * v[x.v_index]
            velocity_bounds(x, q)
            stop_velocity(x)
            way[k] = x.v_stop
        else:
            way[k] = easing_stop(x, v, w)
        w = np.clip(way[k] - v, -x.v_step, x.v_step)
        v = way[k]
        if (np.abs(v) <= AT_REST * x.v_step).all() and (np.abs(w) <= x.w_step).all():
            return k
    return len(way)


def damped_solution(x: Any, v: Array) -> None:
    """A⁺b with A⁺ = Aᵀ (A Aᵀ + λ²)⁻¹.

    Args:
        x: reads A (r, n), b (r,) and the damping λ.
        v: out (n,); NaN where there is no damping and A Aᵀ is close to singular.
    """
    if not len(x.b):
        v.fill(0.0)
        return
    gram = x.gram
    np.dot(x.A, x.A.T, out=gram)
    x.gram_diagonal += x.damping2
    factor, y, info = dposv(gram, x.b)
    if x.damping == 0.0 and info == 0:
        pivots = factor.diagonal() ** 2
        info = int(pivots.min() < WELL_CONDITIONED * pivots.max())
    if info == 0:
        np.dot(y, x.A, out=v)
    else:
        v.fill(np.nan)


def tracking_shortfall(x: Any, k: int) -> float:
    """`shortfall` of v0, with the first k rows."""
    v, rows = x.v0, x.rows(k)
    np.subtract(v, x.upper, out=x.over_upper)
    np.subtract(x.lower, v, out=x.over_lower)
    if k:
        np.dot(rows.J, v, out=rows.outside)
        np.subtract(rows.least, rows.outside, out=rows.outside)
    return float(rows.over.max())


def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """Largest violation of J v >= b and lower <= v <= upper; negative inside, NaN where there is one."""
    over = np.maximum(v - upper, lower - v).max()
    if len(b):
        outside = (b - np.dot(J, v)).max()
        if not (over >= outside or over != over):
            return float(outside)
    return float(over)


def projection_cost(A: Array, regularization: float, v0: Array) -> tuple[Array, Array]:
    """P = AᵀA + λ (n, n) and q = -P v0 (n,): ½ vᵀP v + qᵀv is smallest at v0."""
    P = np.dot(A.T, A)
    P.ravel()[:: len(P) + 1] += regularization
    return P, -np.dot(P, v0)
