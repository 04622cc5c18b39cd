"""`kernels.vectorised.stops` as loops that numba compiles; documented there."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.compiled.bounds import _longest_way, _speed_to_stop, velocity_bounds
from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.stopping import AT_REST
from qpavoid.problem import Array


@compiled
def stop_velocity(x: Any) -> None:
    """See `vectorised.stops.stop_velocity`."""
    slowing = 1.0 if x.accelerated else np.inf
    for j in range(len(x.v_last)):
        slowing = max(slowing, abs(x.v_last[j]) / x.v_step[j])
    share = 1.0 - 1.0 / slowing if x.accelerated else 0.0
    if x.jerked:
        _easing_stop(x, 1.0 / slowing)
    else:
        for j in range(len(x.v_last)):
            x.v_stop[j] = share * x.v_last[j]
    for j in range(len(x.v_last)):
        x.v_stop[j] = min(max(x.v_stop[j], x.lower[j]), x.upper[j])


@compiled
def _easing_stop(x: Any, braking: float) -> None:
    """See `vectorised.stops.easing_stop`."""
    fastest, off = 0.0, 1.0
    for j in range(len(x.v_last)):
        fastest = max(fastest, abs(x.v_last[j]) / x.w_step[j])
    if fastest > 0.0:
        braking = min(braking, _speed_to_stop(fastest, 1.0, 1.0) / fastest)
    for j in range(len(x.v_last)):
        off = max(off, abs(x.w_last[j] + braking * x.v_last[j]) / x.w_step[j])
    kept = 1.0 - 1.0 / off
    share = 1.0 - (1.0 - kept) * braking
    for j in range(len(x.v_last)):
        x.v_stop[j] = share * x.v_last[j] + kept * x.w_last[j]


@compiled
def stop_way(x: Any, q: Array, w: Array, way: Array) -> int:
    """See `vectorised.stops.stop_way`."""
    x.lower[:], x.upper[:] = -np.inf, np.inf
    count = _stop_ticks(x, q, w, way, False)
    below, above = np.full(len(w), np.inf), np.full(len(w), np.inf)
    for i in range(len(x.q_index)):
        here = q[x.q_index[i]]
        below[x.v_index[i]], above[x.v_index[i]] = here - x.q_lower[i], x.q_upper[i] - here
    for j in range(len(w)):
        unit, most = x.w_step[j], x.v_step[j] / x.w_step[j]
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
    """See `vectorised.stops._stop_ticks`."""
    x.v_last[:], x.w_last[:] = way[0], w
    for k in range(1, len(way)):
        if bounded:
            for i in range(len(x.q_index)):
                q[x.q_index[i]] += x.dt * x.v_last[x.v_index[i]]
            velocity_bounds(x, q)
        stop_velocity(x)
        moves = False
        for j in range(len(w)):
            change = x.v_stop[j] - x.v_last[j]
            x.w_last[j], x.v_last[j] = min(max(change, -x.v_step[j]), x.v_step[j]), x.v_stop[j]
            way[k, j] = x.v_stop[j]
            moves = moves or abs(x.v_stop[j]) > AT_REST * x.v_step[j] or abs(x.w_last[j]) > x.w_step[j]
        if not moves:
            return k
    return len(way)
