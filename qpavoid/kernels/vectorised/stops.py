"""Stops within the limits: the next velocity of one, and all of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from qpavoid.kernels.stopping import AT_REST, longest_way
from qpavoid.kernels.vectorised.bounds import velocity_bounds
from qpavoid.problem import Array


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
