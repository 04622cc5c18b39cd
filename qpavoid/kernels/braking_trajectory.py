"""Braking trajectories: the next velocity of a stop of all coordinates, and the whole of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import _max_stopping_distance, _speed_to_stop, velocity_bounds
from qpavoid.kernels.braking_bounds import ZERO_SPEED
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array


@compiled
def stop_velocity(x: Any) -> None:
    """Write to v_stop the next velocity of a stop: v_prev times one factor.

    So no distance closes faster. With s = max |v_j| / v_step_j, the number of steps to a standstill, the factor is 1 -
    1 / s, or 0 from less than a step on; it is 0 without acceleration limits. With jerk limits, see
    `jerk_limited_stop`. Bounds of position and velocity come first: the result is clipped to them.

    Args:
        x: reads v_prev, dv_prev, v_step, dv_step, lower and upper; writes v_stop (n,) [rad/s or m/s].
    """
    if x.jerk_limited:
        x.v_stop[:] = jerk_limited_stop(x.v_prev, x.dv_prev, x.v_step, x.dv_step)
    else:
        steps = 1.0  # to a standstill
        for j in range(len(x.v_prev)):
            steps = max(steps, abs(x.v_prev[j]) / x.v_step[j])
        factor = 1.0 - 1.0 / steps if x.acceleration_limited else 0.0
        for j in range(len(x.v_prev)):
            x.v_stop[j] = factor * x.v_prev[j]
    for j in range(len(x.v_prev)):
        x.v_stop[j] = min(max(x.v_stop[j], x.lower[j]), x.upper[j])


@compiled
def jerk_limited_stop(v: Array, w: Array, v_step: Array, dv_step: Array) -> Array:
    """Compute the next velocity (n,) of a stop within jerk limits, before bounds [rad/s or m/s].

    The fastest stop of all with one factor for all coordinates changes v by -βv: with β = min(1 / s, σ(f) / f), where
    s = max |v_j| / v_step_j, f = max |v_j| / dv_step_j and σ(f) = `speed_to_stop(f, 1, 1)`, neither an acceleration
    limit is passed, nor must v pass zero to take the change back (`kernels.braking_bounds`). The change w goes straight
    towards -βv, in steps that no coordinate's jerk forbids: by the factor 1 / max |w_j + β v_j| / dv_step_j of the
    difference, at most 1. Once it is there, it stays there to the end.

    Args:
        v: velocity (n,) [rad/s or m/s].
        w: change of v in the previous step (n,) [rad/s or m/s].
        v_step: largest change of v in a step (n,), infinite where there is no limit [rad/s or m/s].
        dv_step: largest change of that change from step to step (n,), infinite where there is no limit [rad/s or m/s].
    """
    steps, fastest, excess = 1.0, 0.0, 1.0
    for j in range(len(v)):
        steps = max(steps, abs(v[j]) / v_step[j])
        fastest = max(fastest, abs(v[j]) / dv_step[j])
    braking = 1.0 / steps
    if fastest > 0.0:
        braking = min(braking, _speed_to_stop(fastest, 1.0, 1.0) / fastest)
    for j in range(len(v)):
        excess = max(excess, abs(w[j] + braking * v[j]) / dv_step[j])
    w_factor = 1.0 - 1.0 / excess
    v_factor = 1.0 - (1.0 - w_factor) * braking
    return v_factor * v + w_factor * w


@compiled
def roll_out_stop(x: Any, q: Array, w: Array, velocities: Array) -> int:
    """Write the velocities of the steps of a stop within jerk limits, from velocities[0] on.

    Bounds are applied only where the stop without them may come near a limit of position or velocity, by
    `max_stopping_distance`.

    Args:
        x: memory of its own; the limits are read.
        q: configuration (nq,) before the first of these steps.
        w: change of v that has led to velocities[0] (n,), no larger than v_step [rad/s or m/s].
        velocities: out from row 1 on (m, n), for as many steps as are considered [rad/s or m/s].

    Returns:
        Number of steps in which the robot moves, or m.
    """
    x.lower[:], x.upper[:] = -np.inf, np.inf
    count = _roll_out(x, q, w, velocities, False)
    below, above = np.full(len(w), np.inf), np.full(len(w), np.inf)
    for i in range(len(x.q_index)):
        position = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = position - x.q_lower[i], x.q_upper[i] - position
    for j in range(len(w)):
        unit, w_max = x.dv_step[j], x.v_step[j] / x.dv_step[j]
        if not unit < np.inf:
            if min(below[j], above[j], x.v_max[j]) < np.inf:
                return _roll_out(x, q.copy(), w, velocities, True)
            continue
        fastest = x.v_max[j] / unit * (1.0 + ZERO_SPEED)
        for k in range(1, count):
            below[j] += x.dt * velocities[k - 1, j]
            above[j] -= x.dt * velocities[k - 1, j]
            speed, change = velocities[k, j] / unit, (velocities[k, j] - velocities[k - 1, j]) / unit
            if (
                abs(speed) + 0.5 * change * change > fastest
                or _max_stopping_distance(speed, change, w_max) > above[j] / (x.dt * unit)
                or _max_stopping_distance(-speed, -change, w_max) > below[j] / (x.dt * unit)
            ):
                return _roll_out(x, q.copy(), w, velocities, True)
    return count


@compiled
def _roll_out(x: Any, q: Array, w: Array, velocities: Array, bounded: bool) -> int:
    """Roll out a stop as `roll_out_stop` does, with the bounds of every configuration, or without any.

    Args:
        x: memory of its own; v_prev, dv_prev, v_stop and, if bounded, the bounds are overwritten.
        q: configuration (nq,); overwritten if bounded.
        w: change of v that has led to velocities[0] (n,) [rad/s or m/s].
        velocities: out from row 1 on (m, n) [rad/s or m/s].
        bounded: whether bounds of position and velocity are applied.

    Returns:
        Number of steps in which the robot moves, or m.
    """
    x.v_prev[:], x.dv_prev[:] = velocities[0], w
    for k in range(1, len(velocities)):
        if bounded:
            for i in range(len(x.q_index)):
                q[x.q_index[i]] += x.dt * x.v_prev[x.v_index[i]]
            velocity_bounds(x, q)
        stop_velocity(x)
        moves = False
        for j in range(len(w)):
            change = x.v_stop[j] - x.v_prev[j]
            x.dv_prev[j], x.v_prev[j] = min(max(change, -x.v_step[j]), x.v_step[j]), x.v_stop[j]
            velocities[k, j] = x.v_stop[j]
            moves = moves or abs(x.v_stop[j]) > ZERO_SPEED * x.v_step[j] or abs(x.dv_prev[j]) > x.dv_step[j]
        if not moves:
            return k
    return len(velocities)
