"""Rows of the pairs that are near, and how fast they may close."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import _change_to_stop
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

BRAKING_SHARE = 0.5
"""Share of the joints' accelerations on which a pair counts for braking; other pairs want some, too [-]."""
OWN_CAP = 1.0
"""Largest α of a pair of two bodies of the robot, which may be unable to part [-]."""
TINY = 1e-300
"""Distance that α takes for none: no division by zero [m]."""


@compiled
def _fold(row: Array, columns: IntArray, folded: Array) -> None:
    """Add up the columns (e,) of a Jacobian's row that one coordinate moves (n,)."""
    folded[:] = 0.0
    for c in range(len(row)):
        folded[columns[c]] += row[c]


@compiled
def distance_rows(x: Any, pairs: IntArray, reach: float, moving: bool) -> int:
    """Write the closest points and rates of the pairs that are nearer than `reach`, or whose distance is NaN.

    The normal n is parallel to the line between the witness points, so p × n is the same at both, and every row is
    J = [n, p × n]ᵀ J_world, times the difference of the supports of the two bodies.

    Args:
        x: reads results, J_world, support, twists, twist_row; writes near, closest, J, drift.
        pairs: which pairs to consider (c,), increasing.
        reach: distance below which a pair is near [m].
        moving: whether any of the twists is not zero.

    Returns:
        Number of near pairs.
    """
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
            x.feedforward[k] = 0.0
            if moving:
                t = x.twists[x.twist_row[i]]
                x.feedforward[k] = nx * t[0] + ny * t[1] + nz * t[2] + mx * t[3] + my * t[4] + mz * t[5]
            k += 1
    return k


@compiled
def row_bounds(x: Any, k: int, moving: bool) -> None:
    """Write the right-hand sides of the first k avoidance rows: d, least and touch; see `qpavoid.control.avoidance`.

    With acceleration limits, a pair closes no faster than the speed from which a share of its joints' accelerations,
    all at work on it, brings it to rest in what is left: ½ a dt - √((½ a dt)² + 2 a h).

    A row never asks for more than can be had: of a pair that may still close, and whose obstacle does not come nearer,
    no more than a stop gives, so that the stop meets all such rows at once; of one that has to part, no more speed of
    parting than the bounds allow, and where they do not allow any yet, no harder braking. Task-switching rows, which
    extend to d2, ask beyond what the bounds allow for no more than a damper would.

    Args:
        x: reads what `distance_rows`, `velocity_bounds` and `stop_velocity` wrote; writes d, least, touch.
        k: number of near pairs.
        moving: whether any obstacle moves or has a margin.
    """
    for i in range(k):
        slack = x.distance_allowance[x.near[i]]
        d = x.closest[i, 0] + x.offset - x.margin[x.twist_row[x.near[i]]] + slack
        value = x.row_gain * (x.hold - d)
        parting = value > 0.0
        if x.beta and not parting:
            value *= 1.0 - _beta(x, d)
        elif x.task_switching:
            value = max(_rate_of_eq10(x, i, d), value if parting else (x.hold - d) / x.dt)
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
        least = min(value, x.recovery) - x.feedforward[i]
        farther = x.task_switching and not parting
        if parting or farther:
            most = 0.0
            for c in range(len(x.lower)):
                if x.J[i, c] > 0.0:
                    most += x.J[i, c] * x.upper[c]
                elif x.J[i, c] < 0.0:
                    most += x.J[i, c] * x.lower[c]
            if farther:
                most = max(most, x.row_gain * (x.hold - d) - x.feedforward[i])
            elif x.feedforward[i] < 0.0:
                most = max(most, -x.feedforward[i])
            least = min(least, most)
        if x.accelerated and x.feedforward[i] >= 0.0 and not parting:
            stop = 0.0
            for c in range(len(x.lower)):
                stop += x.J[i, c] * x.v_stop[c]
            least = min(least, stop)
        x.d[i] = d
        x.least[i] = least
        x.touch[i] = min(x.row_gain * (x.offset + slack - d) - x.feedforward[i], least)


@compiled
def _beta(x: Any, d: float) -> float:
    """Compute β(d) of eq. 12, see `gains.beta`."""
    return 0.5 + 0.5 * np.cos(np.pi * min(max((d - x.d1) / (x.d2 - x.d1), 0.0), 1.0))


@compiled
def _rate_of_eq10(x: Any, i: int, d: float) -> float:
    """Compute the rate J_d q̇ [m/s] of near pair i that eq. 10 with the consistent bracket gives, undamped, J_d N != 0.

    That is (1 - β)(1 - α) min(u, ẋ0) + β ẋ0, with u = J v0 + drift and α for u < 0 only. As a lower bound it asks of a
    pair that parts by itself for no more than ẋ0. α > 1 asks a pair that closes in to part: of two bodies of the robot,
    as of neighbouring links, the cap is 1, so that for ẋ0 = 0 rest meets all of them.

    Args:
        x: reads J, v0, drift, d1, d2, alpha_cap, retreat_speed, margin, near, twist_row.
        i: number of the near pair.
        d: its distance [m].
    """
    u = x.feedforward[i]
    for c in range(len(x.v_tracking)):
        u += x.J[i, c] * x.v_tracking[c]
    rate, beta = min(u, x.retreat_speed), _beta(x, d)
    if u < 0.0:
        ratio = max(x.d2 - d, 0.0) / max(d, TINY)
        own = x.twist_row[x.near[i]] == len(x.margin) - 1
        rate *= 1.0 - min(ratio * ratio, min(x.alpha_cap, OWN_CAP) if own else x.alpha_cap)
    return (1.0 - beta) * rate + beta * x.retreat_speed


@compiled
def _room_for_jerk(x: Any, i: int, value: float, step: float, room: float) -> float:
    """Compute the bound of closing pair i from which a share of its joints' jerks, too, brings it to rest in time.

    It counts from the change of speed that has led to the speed of closing; see `kernels.stopping`.

    Args:
        x: reads J, drift, v_last, w_last, w_step.
        i: number of the near pair.
        value: its bound so far [m/s]; all jerks at work on a pair change the change of its speed no more than this.
        step: change of the speed of closing that a share of the joints' accelerations makes in a tick [m/s].
        room: distance left over the length of a tick [m/s].

    Returns:
        Bound [m/s]; -∞ where the jerks of its joints have no limit.
    """
    speed, change, unit = -x.feedforward[i], 0.0, 0.0
    for c in range(len(x.v_prev)):
        if x.J[i, c] != 0.0:
            speed -= x.J[i, c] * x.v_prev[c]
            change -= x.J[i, c] * x.dv_prev[c]
            unit += abs(x.J[i, c]) * x.dv_step[c]
    unit *= BRAKING_SHARE
    if not 0.0 < unit < np.inf:
        return -np.inf
    high = min((-value - speed) / unit, change / unit + 1.0 / BRAKING_SHARE)
    change = _change_to_stop(speed / unit, high, -np.inf, step / unit, room / unit)
    return -speed - unit * change
