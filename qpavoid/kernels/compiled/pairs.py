"""`kernels.vectorised.pairs` as loops that numba compiles; documented there."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.compiled.bounds import _change_to_stop
from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.vectorised.pairs import BRAKING_SHARE
from qpavoid.problem import Array, IntArray


@compiled
def _fold(row: Array, columns: IntArray, folded: Array) -> None:
    """Adds up the columns (e,) of a Jacobian's row that one coordinate moves (n,)."""
    folded[:] = 0.0
    for c in range(len(row)):
        folded[columns[c]] += row[c]


@compiled
def distance_rows(x: Any, pairs: IntArray, reach: float, moving: bool) -> int:
    """See `vectorised.pairs.distance_rows`."""
    results, closest, J, support = x.results, x.closest, x.J, x.support
    J_world = np.ascontiguousarray(x.J_world)  # rows in one piece become vector instructions
    columns = J_world.shape[1]
    k = 0
    for i in pairs:
        if not results[i, 0] >= reach:
            x.near[k] = i
            for c in range(10):
                closest[k, c] = results[i, c]
            nx, ny, nz = results[i, 1], results[i, 2], results[i, 3]
            px, py, pz = results[i, 4], results[i, 5], results[i, 6]
            mx, my, mz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
            row = x.mimicking if x.mimics else J[k]
            for c in range(columns):
                linear = nx * J_world[0, c] + ny * J_world[1, c] + nz * J_world[2, c]
                angular = mx * J_world[3, c] + my * J_world[4, c] + mz * J_world[5, c]
                row[c] = (linear + angular) * support[i, c]
            if x.mimics:
                _fold(row, x.columns, J[k])
            x.drift[k] = 0.0
            if moving:
                t = x.twists[x.twist_row[i]]
                x.drift[k] = nx * t[0] + ny * t[1] + nz * t[2] + mx * t[3] + my * t[4] + mz * t[5]
            k += 1
    return k


@compiled
def row_bounds(x: Any, k: int, moving: bool) -> None:
    """See `vectorised.pairs.row_bounds`."""
    for i in range(k):
        slack = x.slack[x.near[i]]
        d = x.closest[i, 0] + x.offset - x.margin[x.twist_row[x.near[i]]] + slack
        value = x.row_gain * (x.hold - d)
        parting = value > 0.0
        if x.switching and not parting:
            share = min(max((d - x.d1) / (x.d2 - x.d1), 0.0), 1.0)
            value *= 0.5 - 0.5 * np.cos(np.pi * share)
        if x.accelerated and value < 0.0:
            braking = 0.0
            for c in range(len(x.v_step)):
                if x.J[i, c] != 0.0:
                    braking += abs(x.J[i, c]) * x.v_step[c]
            if braking < np.inf:
                braking *= 0.5 * BRAKING_SHARE
                room = max(d - x.hold, 0.0) / x.dt
                value = max(value, braking - np.sqrt(braking * braking + 4.0 * braking * room))
                if x.jerked:
                    value = max(value, _room_for_jerk(x, i, value, 2.0 * braking, room))
        least = min(value, x.recovery) - x.drift[i]
        if parting:
            most = 0.0
            for c in range(len(x.lower)):
                if x.J[i, c] > 0.0:
                    most += x.J[i, c] * x.upper[c]
                elif x.J[i, c] < 0.0:
                    most += x.J[i, c] * x.lower[c]
            if x.drift[i] < 0.0:
                most = max(most, -x.drift[i])
            least = min(least, most)
        elif x.accelerated and x.drift[i] >= 0.0:
            stop = 0.0
            for c in range(len(x.lower)):
                stop += x.J[i, c] * x.v_stop[c]
            least = min(least, stop)
        x.d[i] = d
        x.least[i] = least
        x.touch[i] = min(x.row_gain * (x.offset + slack - d) - x.drift[i], least)


@compiled
def _room_for_jerk(x: Any, i: int, value: float, step: float, room: float) -> float:
    """See `vectorised.pairs._room_for_jerk`."""
    speed, change, unit = -x.drift[i], 0.0, 0.0
    for c in range(len(x.v_last)):
        if x.J[i, c] != 0.0:
            speed -= x.J[i, c] * x.v_last[c]
            change -= x.J[i, c] * x.w_last[c]
            unit += abs(x.J[i, c]) * x.w_step[c]
    unit *= BRAKING_SHARE
    if not 0.0 < unit < np.inf:
        return -np.inf
    high = min((-value - speed) / unit, change / unit + 1.0 / BRAKING_SHARE)
    change = _change_to_stop(speed / unit, high, -np.inf, step / unit, room / unit)
    return -speed - unit * change
