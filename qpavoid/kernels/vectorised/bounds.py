"""Bounds on v from the limits of the joints."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.stopping import MOST_STEPS, longest_way, way_to_stop
from qpavoid.problem import Array


def velocity_bounds(x: Any, q: Array) -> float:
    """Bounds on v from the joint limits: see `qpavoid.limits`; writes hard_lower, hard_upper, lower and upper.

    Returns:
        Room that is left to the nearest position limit [rad, m]: negative outside, infinite where there are none.
    """
    room = x.room  # [lower, upper]: how far the coordinate is above its lower limit, and below the upper one
    np.subtract(x.q_limits, q if x.plain else q[x.q_index], out=room)
    least = min(room[1].min(initial=np.inf), -room[0].max(initial=-np.inf))
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
    return float(least)


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
