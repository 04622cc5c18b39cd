"""Bounds on v from the limits of the joints."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.kernels.stopping import MOST_STEPS, longest_way, speed_to_stop, way_to_stop
from qpavoid.problem import Array

_speed_to_stop, _way_to_stop, _longest_way = compiled(speed_to_stop), compiled(way_to_stop), compiled(longest_way)


@compiled
def velocity_bounds(x: Any, q: Array) -> float:
    """Write the bounds on v from the joint limits: hard_lower, hard_upper, lower and upper; see `qpavoid.model.limits`.

    A coordinate outside a position limit is sent back at a rate, from which it can still brake for the opposite limit.

    Args:
        x: reads the limits, v_last and w_last; writes the bounds.
        q: configuration (nq,).

    Returns:
        Distance to the nearest position limit [rad, m]: negative outside, infinite where there are none.
    """
    lower, upper, least = x.hard_lower, x.hard_upper, np.inf
    for j in range(len(x.v_max)):
        lower[j], upper[j] = -x.v_max[j], x.v_max[j]
    for i in range(len(x.q_index)):
        j, here = x.v_index[i], q[x.q_index[i]]
        fastest, step, last = x.v_max[j], x.v_step[j], x.v_prev[j]
        below, above = here - x.q_lower[i], x.q_upper[i] - here
        least = min(least, below, above)
        if step < np.inf:
            faster, slower = min(step, x.dv_step[j] + x.dv_prev[j]), min(step, x.dv_step[j] - x.dv_prev[j])
            down = _speed_to_stop(below, step, x.dt) if below > 0.0 else max(x.rate * below, -last - faster)
            up = _speed_to_stop(above, step, x.dt) if above > 0.0 else max(x.rate * above, last - slower)
            if below < 0.0:
                down = max(down, -up)  # on the way back from outside one limit it can still brake for the other
            elif above < 0.0:
                up = max(up, -down)
        else:
            down, up = x.rate * below, x.rate * above
        lower[j] = max(min(-down, fastest), -fastest)
        upper[j] = max(min(up, fastest), -fastest)
    if x.jerked:
        _within_jerk(x, q)
    for j in range(len(x.v_max)):
        low = min(max(x.v_prev[j] - x.v_step[j], lower[j]), upper[j])
        high = max(min(x.v_prev[j] + x.v_step[j], upper[j]), lower[j])
        if x.jerked:
            low, high = min(max(x.lower[j], low), high), max(min(x.upper[j], high), low)
        x.lower[j], x.upper[j] = low, high
    return least


@compiled
def _within_jerk(x: Any, q: Array) -> None:
    """Write to lower and upper the bounds on v between which the stops of `kernels.stopping` end within the limits.

    They never cross, as the stop's own next velocity is between them from any state. Of a coordinate outside its
    position limits, the hard bounds that send it back are relaxed to what it needs to stop before the opposite limit;
    once on its way back, it does not turn round again.

    Args:
        x: reads the limits, v_last and w_last; writes lower, upper, and the hard bounds of coordinates outside.
        q: configuration (nq,).
    """
    below, above = np.full(len(x.v_max), np.inf), np.full(len(x.v_max), np.inf)
    for i in range(len(x.q_index)):
        here = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = here - x.q_lower[i], x.q_upper[i] - here
    for j in range(len(x.v_max)):
        x.lower[j], x.upper[j] = -np.inf, np.inf
        unit = x.dv_step[j]
        if not unit < np.inf:
            continue
        speed, change, most, fastest = x.v_prev[j] / unit, x.dv_prev[j] / unit, x.v_step[j] / unit, x.v_max[j] / unit
        target = min(_speed_to_stop(abs(speed), 1.0, 1.0), most)
        stop = min(max(-target if speed > 0.0 else target, change - 1.0), change + 1.0)
        faster, deeper = fastest if above[j] >= 0.0 else 0.0, fastest if below[j] >= 0.0 else 0.0
        high = min(change + 1.0, most, _speed_to_stop(max(faster - speed, 0.0), 1.0, 1.0))
        deep = min(1.0 - change, most, _speed_to_stop(max(deeper + speed, 0.0), 1.0, 1.0))
        up = _change_to_stop(speed, high, stop, most, max(above[j], 0.0) / (x.dt * unit))
        down = _change_to_stop(-speed, deep, -stop, most, max(below[j], 0.0) / (x.dt * unit))
        x.lower[j], x.upper[j] = x.v_prev[j] - unit * down, x.v_prev[j] + unit * up
        if above[j] < 0.0:
            x.hard_upper[j] = max(x.hard_upper[j], min(x.lower[j], x.v_max[j]))
        elif below[j] < 0.0:
            x.hard_lower[j] = min(x.hard_lower[j], max(x.upper[j], -x.v_max[j]))


@compiled
def _change_to_stop(speed: float, high: float, low: float, most: float, room: float) -> float:
    """Compute the largest change of v, between `low` and `high`, after which a stop ends within `room`.

    Newton's method from above, on the convex way of `kernels.stopping.way_to_stop`, with its units.

    Args:
        speed: v before the change.
        high: largest change that matters.
        low: what is returned where no larger change will do.
        most: largest change that the acceleration allows.
        room: distance left, not negative.
    """
    change = high
    for _ in range(MOST_STEPS):
        way, growth = _way_to_stop(speed + change, change, most)
        if not way > room:
            break
        change -= (way - room) / growth
    return max(change, low)
