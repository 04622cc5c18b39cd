"""Stops within the limits: the next velocity of one, and all of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import _longest_way, _speed_to_stop, velocity_bounds
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.stopping import AT_REST
from qpavoid.problem import Array


@compiled
def stop_velocity(x: Any) -> None:
    """Write to v_stop the next velocity of a stop: v_last times one factor, so that no distance closes faster.

    Bounds of position and velocity come first. Without acceleration limits it is a standstill, if they allow that.
    With jerk limits, see `easing_stop`.
    """
    if x.jerked:
        x.v_stop[:] = easing_stop(x.v_prev, x.dv_prev, x.v_step, x.dv_step)
    else:
        slowing = 1.0  # number of ticks to a standstill
        for j in range(len(x.v_prev)):
            slowing = max(slowing, abs(x.v_prev[j]) / x.v_step[j])
        share = 1.0 - 1.0 / slowing if x.accelerated else 0.0
        for j in range(len(x.v_prev)):
            x.v_stop[j] = share * x.v_prev[j]
    for j in range(len(x.v_prev)):
        x.v_stop[j] = min(max(x.v_stop[j], x.lower[j]), x.upper[j])


@compiled
def easing_stop(v: Array, w: Array, v_step: Array, dv_step: Array) -> Array:
    """Compute the next velocity of a stop within jerk limits, before bounds.

    The change of v goes straight towards that of the stop that would be the fastest of all with one factor for all
    coordinates, in steps that no coordinate's jerk forbids; once it is there, it stays there to the end.

    Args:
        v: velocity (n,).
        w: by how much it has just changed (n,).
        v_step: largest change of v in a tick (n,), infinite where there is no limit.
        dv_step: largest change of that change from tick to tick (n,), infinite where there is no limit.

    Returns:
        Velocity (n,).
    """
    slowing, fastest, off = 1.0, 0.0, 1.0
    for j in range(len(v)):
        slowing = max(slowing, abs(v[j]) / v_step[j])
        fastest = max(fastest, abs(v[j]) / dv_step[j])
    braking = 1.0 / slowing
    if fastest > 0.0:
        braking = min(braking, _speed_to_stop(fastest, 1.0, 1.0) / fastest)
    for j in range(len(v)):
        off = max(off, abs(w[j] + braking * v[j]) / dv_step[j])
    kept = 1.0 - 1.0 / off
    share = 1.0 - (1.0 - kept) * braking
    return share * v + kept * w


@compiled
def stop_way(x: Any, q: Array, w: Array, way: Array) -> int:
    """Write the velocities of the ticks of a stop within jerk limits, from the velocity way[0] on.

    Bounds are applied only where the stop without them may come near a limit of position or velocity.

    Args:
        x: memory of its own; the limits are read.
        q: configuration (nq,) before the first of these ticks.
        w: change of v that has led to way[0] (n,), no larger than v_step.
        way: out, room for as many ticks as are considered (m, n).

    Returns:
        Number of ticks in which the robot moves, or m.
    """
    x.lower[:], x.upper[:] = -np.inf, np.inf
    count = _stop_ticks(x, q, w, way, False)
    below, above = np.full(len(w), np.inf), np.full(len(w), np.inf)
    for i in range(len(x.q_index)):
        here = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = here - x.q_lower[i], x.q_upper[i] - here
    for j in range(len(w)):
        unit, most = x.dv_step[j], x.v_step[j] / x.dv_step[j]
        if not unit < np.inf:
            if min(below[j], above[j], x.v_max[j]) < np.inf:
                return _stop_ticks(x, q.copy(), w, way, True)
            continue
        fastest = x.v_max[j] / unit * (1.0 + AT_REST)
        for k in range(1, count):
            below[j] += x.dt * way[k - 1, j]
            above[j] -= x.dt * way[k - 1, j]
            speed, change = way[k, j] / unit, (way[k, j] - way[k - 1, j]) / unit
            if (
                abs(speed) + 0.5 * change * change > fastest
                or _longest_way(speed, change, most) > above[j] / (x.dt * unit)
                or _longest_way(-speed, -change, most) > below[j] / (x.dt * unit)
            ):
                return _stop_ticks(x, q.copy(), w, way, True)
    return count


@compiled
def _stop_ticks(x: Any, q: Array, w: Array, way: Array, bounded: bool) -> int:
    """Follow a stop as `stop_way` does, with all bounds at all places of the way, or with none; overwrites q."""
    x.v_prev[:], x.dv_prev[:] = way[0], w
    for k in range(1, len(way)):
        if bounded:
            for i in range(len(x.q_index)):
                q[x.q_index[i]] += x.dt * x.v_prev[x.v_index[i]]
            velocity_bounds(x, q)
        stop_velocity(x)
        moves = False
        for j in range(len(w)):
            change = x.v_stop[j] - x.v_prev[j]
            x.dv_prev[j], x.v_prev[j] = min(max(change, -x.v_step[j]), x.v_step[j]), x.v_stop[j]
            way[k, j] = x.v_stop[j]
            moves = moves or abs(x.v_stop[j]) > AT_REST * x.v_step[j] or abs(x.dv_prev[j]) > x.dv_step[j]
        if not moves:
            return k
    return len(way)
