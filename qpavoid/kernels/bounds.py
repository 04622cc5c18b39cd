"""Bounds on v from the limits of the joints."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.braking_bounds import MAX_NEWTON_STEPS, max_stopping_distance, speed_to_stop, stopping_distance
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array

OUTSIDE = 1e-6
"""Excess over a position limit from which a coordinate counts as outside it: above rounding errors [rad or m]."""
_speed_to_stop, _stopping_distance = compiled(speed_to_stop), compiled(stopping_distance)
_max_stopping_distance = compiled(max_stopping_distance)


@compiled
def velocity_bounds(x: Any, q: Array) -> float:
    """Write the bounds on v from the joint limits; return the distance to the nearest one.

    Position and velocity limits make hard_lower and hard_upper: ±v_max, and towards a position limit at most the speed
    from which the coordinate can still brake, `speed_to_stop`; without an acceleration limit, `position_rate` times the
    distance. Outside a position limit, the speed back is `position_rate` times the excess, at most `v_recovery`, as
    far as the limits allow it, and low enough to brake before the opposite limit. Acceleration and jerk limits narrow
    these to lower and upper: v_prev ± v_step, and `_jerk_limited_bounds`. No bound ever crosses another one; where
    limits contradict, the hard bounds hold. See `qpavoid.model.limits`.

    Args:
        x: reads the limits, v_prev and dv_prev; writes hard_lower, hard_upper, lower and upper (n,) [rad/s or m/s], and
            centering.
        q: configuration (nq,).

    Returns:
        Distance to the nearest position limit [rad, m]: negative outside, infinite where there are none.
    """
    lower, upper, margin = x.hard_lower, x.hard_upper, np.inf
    for j in range(len(x.v_max)):
        lower[j], upper[j] = -x.v_max[j], x.v_max[j]
    for i in range(len(x.q_index)):
        j, position = x.v_index[i], q[x.q_index[i]]
        fastest, step, v_prev = x.v_max[j], x.v_step[j], x.v_prev[j]
        slowest = -x.v_recovery[j]
        below, above = position - x.q_lower[i], x.q_upper[i] - position
        margin = min(margin, below, above)
        width = x.q_upper[i] - x.q_lower[i]
        x.centering[j] = min(max((above - below) / width, -1.0), 1.0) if width < np.inf else 0.0
        if step < np.inf:
            faster, slower = min(step, x.dv_step[j] + x.dv_prev[j]), min(step, x.dv_step[j] - x.dv_prev[j])
            back_up, back_down = max(x.position_rate * below, slowest), max(x.position_rate * above, slowest)
            down = _speed_to_stop(below, step, x.dt) if below > 0.0 else max(back_up, -v_prev - faster)
            up = _speed_to_stop(above, step, x.dt) if above > 0.0 else max(back_down, v_prev - slower)
            if below < 0.0:
                down = max(down, -up)  # while it returns from outside one limit it can still brake for the other
            elif above < 0.0:
                up = max(up, -down)
        else:
            down, up = max(x.position_rate * below, slowest), max(x.position_rate * above, slowest)
        lower[j] = max(min(-down, fastest), -fastest)
        upper[j] = max(min(up, fastest), -fastest)
    if x.jerk_limited:
        _jerk_limited_bounds(x, q)
    for j in range(len(x.v_max)):
        low = min(max(x.v_prev[j] - x.v_step[j], lower[j]), upper[j])
        high = max(min(x.v_prev[j] + x.v_step[j], upper[j]), lower[j])
        if x.jerk_limited:
            low, high = min(max(x.lower[j], low), high), max(min(x.upper[j], high), low)
        x.lower[j], x.upper[j] = low, high
    return margin


@compiled
def _jerk_limited_bounds(x: Any, q: Array) -> None:
    """Write to lower and upper the bounds on v within jerk limits.

    From velocities between them, the stops of `kernels.braking_bounds` end within the position and velocity limits.
    They never cross, as the stop's own next velocity is between them from any state. Of a coordinate outside its
    position limits, the hard bounds that demand its return are relaxed to what it needs to stop before the opposite
    limit, and to come to the speed of its return without overshoot; once it returns, it does not turn round again.

    Args:
        x: reads the limits, v_prev and dv_prev; writes lower, upper (n,), and the hard bounds of coordinates outside
            [rad/s or m/s].
        q: configuration (nq,).
    """
    below, above = np.full(len(x.v_max), np.inf), np.full(len(x.v_max), np.inf)
    for i in range(len(x.q_index)):
        position = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = position - x.q_lower[i], x.q_upper[i] - position
    for j in range(len(x.v_max)):
        x.lower[j], x.upper[j] = -np.inf, np.inf
        unit = x.dv_step[j]
        if not unit < np.inf:
            continue
        speed, change, w_max, fastest = x.v_prev[j] / unit, x.dv_prev[j] / unit, x.v_step[j] / unit, x.v_max[j] / unit
        target = min(_speed_to_stop(abs(speed), 1.0, 1.0), w_max)
        stop = min(max(-target if speed > 0.0 else target, change - 1.0), change + 1.0)
        v_up, v_down = fastest if above[j] >= 0.0 else 0.0, fastest if below[j] >= 0.0 else 0.0
        max_up = min(change + 1.0, w_max, _speed_to_stop(max(v_up - speed, 0.0), 1.0, 1.0))
        max_down = min(1.0 - change, w_max, _speed_to_stop(max(v_down + speed, 0.0), 1.0, 1.0))
        up = _change_to_stop(speed, max_up, stop, w_max, max(above[j], 0.0) / (x.dt * unit))
        down = _change_to_stop(-speed, max_down, -stop, w_max, max(below[j], 0.0) / (x.dt * unit))
        x.lower[j], x.upper[j] = x.v_prev[j] - unit * down, x.v_prev[j] + unit * up
        if above[j] < 0.0:
            return_fall = _speed_to_stop(max(x.v_prev[j] - x.hard_upper[j], 0.0) / unit, 1.0, 1.0)
            soonest = max(x.lower[j], x.v_prev[j] - unit * return_fall)
            x.hard_upper[j] = max(x.hard_upper[j], min(soonest, x.v_max[j]))
        elif below[j] < 0.0:
            return_rise = _speed_to_stop(max(x.hard_lower[j] - x.v_prev[j], 0.0) / unit, 1.0, 1.0)
            soonest = min(x.upper[j], x.v_prev[j] + unit * return_rise)
            x.hard_lower[j] = min(x.hard_lower[j], max(soonest, -x.v_max[j]))


@compiled
def _change_to_stop(speed: float, high: float, low: float, w_max: float, distance: float) -> float:
    """Compute the largest change of v, in [low, high], after which a stop takes at most `distance`.

    Newton's method from above, on the convex `stopping_distance`, in the units of `kernels.braking_bounds`.

    Args:
        speed: v before the change.
        high: largest change that is considered.
        low: result where no larger change will do.
        w_max: largest change that the acceleration limit allows.
        distance: to the limit, not negative.
    """
    change = high
    for _ in range(MAX_NEWTON_STEPS):
        needed, slope = _stopping_distance(speed + change, change, w_max)
        if not needed > distance:
            break
        change -= (needed - distance) / slope
    return max(change, low)
