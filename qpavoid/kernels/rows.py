"""Rows of the near pairs, and lower bounds on the rates of their distances."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import _change_to_stop
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

BRAKING_FRACTION = 0.5
"""Share of the joints' accelerations that one pair may use for braking [-]: other pairs need some at the same time."""
OWN_ALPHA_CAP = 1.0
"""Largest α of a pair of two bodies of the robot [-]: beyond 1 it asks for separation, which may be impossible."""
MIN_DISTANCE = 1e-300
"""Distance that stands for 0 and less in α [m]: no division by zero."""


@compiled
def _fold(row: Array, columns: IntArray, folded: Array) -> None:
    """Add up the columns of a Jacobian's row that the same coordinate moves.

    Args:
        row: (e,).
        columns: coordinate of each column (e,).
        folded: out (n,).
    """
    folded[:] = 0.0
    for c in range(len(row)):
        folded[columns[c]] += row[c]


@compiled
def distance_rows(x: Any, pairs: IntArray, influence_distance: float, moving: bool) -> int:
    """Write witness points, Jacobians and feed-forward of the pairs below `influence_distance`, or at NaN.

    With the unit normal n from body a to b, the distance changes at ḋ = n·(ṗ_b - ṗ_a) = J v + ḋ_obs. n is parallel to
    the line between the witness points, so p × n is the same at both, and every row is J = [n, p × n]ᵀ J_world times
    the difference of the supports of the two bodies. ḋ_obs = [n, p × n]ᵀ t with the twist t of the obstacle at the
    world's origin.

    Args:
        x: reads results, J_world, support, twists, twist_row, margin; writes near_pairs, closest, J, feedforward.
        pairs: numbers of the pairs that are considered (c,), increasing.
        influence_distance: surface distance, less the margin, below which a pair is near [m].
        moving: whether any of the twists is not zero.

    Returns:
        Number k of near pairs.
    """
    results, closest, J, J_world, support = x.results, x.closest, x.J, x.J_world, x.support
    columns = J_world.shape[1]
    k = 0
    for i in pairs:
        if not results[i, 0] - x.margin[x.twist_row[i]] >= influence_distance:
            x.near_pairs[k] = i
            for c in range(10):
                closest[k, c] = results[i, c]
            nx, ny, nz = results[i, 1], results[i, 2], results[i, 3]
            px, py, pz = results[i, 4], results[i, 5], results[i, 6]
            mx, my, mz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
            row = x.unfolded_row if x.has_mimics else J[k]
            for c in range(columns):
                linear = nx * J_world[0, c] + ny * J_world[1, c] + nz * J_world[2, c]
                angular = mx * J_world[3, c] + my * J_world[4, c] + mz * J_world[5, c]
                row[c] = (linear + angular) * support[i, c]
            if x.has_mimics:
                _fold(row, x.columns, J[k])
            x.feedforward[k] = 0.0
            if moving:
                t = x.twists[x.twist_row[i]]
                x.feedforward[k] = nx * t[0] + ny * t[1] + nz * t[2] + mx * t[3] + my * t[4] + mz * t[5]
            k += 1
    return k


@compiled
def row_bounds(x: Any, k: int, moving: bool) -> None:
    """Write the right-hand sides of the first k avoidance rows; see `qpavoid.control.avoidance`.

    The row is ḋ = J v + ḋ_obs >= ξ (d1 - d); below d1, at most `recovery_speed`. Above d1 the right-hand side is
    weighted with 1 - β(d), as far as it then still allows `near_speed`; with `task_switching` it is that of eq. 10. The
    row without a margin, of d1 = 0, is ξ (offset - d) - ḋ_obs, or rhs where that is less.

    With acceleration limits, a pair closes no faster than the speed from which a share of its joints' accelerations,
    all at work on it, brings it to rest within the distance h = d - d1: ½ a dt - √((½ a dt)² + 2 a h).

    A row never asks for more than is possible: of a pair that may still close, and whose obstacle does not come nearer,
    no more than a stop gives, so that the stop meets all such rows at once; of one that has to separate, no more speed
    of separation than the bounds allow, and where they do not allow any yet, no harder braking. Task-switching rows,
    which extend to d2, ask beyond what the bounds allow for no more than a damper would.

    Args:
        x: reads what `distance_rows`, `velocity_bounds` and `stop_velocity` wrote; writes d [m], rhs and rhs_contact
            [m/s].
        k: number of near pairs.
        moving: whether any obstacle moves or has a margin.
    """
    for i in range(k):
        slack = x.distance_allowance[x.near_pairs[i]]
        d = x.closest[i, 0] + x.offset - x.margin[x.twist_row[x.near_pairs[i]]] + slack
        rate = x.row_gain * (x.d1 - d)
        separating = rate > 0.0
        if x.task_switching:
            rate = max(_rate_of_eq10(x, i, d), rate if separating else (x.d1 - d) / x.dt)
        elif not separating:
            rate = min((1.0 - beta(d, x.d1, x.d2)) * rate, max(rate, -x.near_speed))
        if x.acceleration_limited and rate < 0.0:
            braking = 0.0
            for c in range(len(x.v_step)):
                if x.J[i, c] != 0.0:
                    braking += abs(x.J[i, c]) * x.v_step[c]
            if braking < np.inf:
                braking *= 0.5 * BRAKING_FRACTION
                clearance = max(d - x.d1, 0.0) / x.dt
                rate = max(rate, braking - np.sqrt(braking * braking + 4.0 * braking * clearance))
                if x.jerk_limited:
                    rate = max(rate, _jerk_limited_closing(x, i, rate, 2.0 * braking, clearance))
        rhs = min(rate, x.recovery_speed) - x.feedforward[i]
        switching = x.task_switching and not separating
        if separating or switching:
            possible = 0.0
            for c in range(len(x.lower)):
                if x.J[i, c] > 0.0:
                    possible += x.J[i, c] * x.upper[c]
                elif x.J[i, c] < 0.0:
                    possible += x.J[i, c] * x.lower[c]
            if switching:
                possible = max(possible, x.row_gain * (x.d1 - d) - x.feedforward[i])
            elif x.feedforward[i] < 0.0:
                possible = max(possible, -x.feedforward[i])
            rhs = min(rhs, possible)
        if x.acceleration_limited and x.feedforward[i] >= 0.0 and not separating:
            stop = 0.0
            for c in range(len(x.lower)):
                stop += x.J[i, c] * x.v_stop[c]
            rhs = min(rhs, stop)
        x.d[i] = d
        x.rhs[i] = rhs
        x.rhs_contact[i] = min(x.row_gain * (x.offset + slack - d) - x.feedforward[i], rhs)


@compiled
def alpha(d: float, d2: float) -> float:
    """Compute the share of the approaching primary motion that is removed (eq. 11).

    Args:
        d: distance [m].
        d2: influence distance [m].

    Returns:
        0 for d >= d2, ((d2 - d)/d)² below, infinite for d <= 0 [-]; callers cap it.
    """
    ratio = max(d2 - d, 0.0) / max(d, MIN_DISTANCE)
    return ratio * ratio


@compiled
def beta(d: float, d1: float, d2: float) -> float:
    """Compute the weight of the avoidance task (eq. 12): a cosine blend from 1 at d1 to 0 at d2 [-].

    Args:
        d: distance [m].
        d1: distance below which it is 1 [m].
        d2: distance above which it is 0 [m].
    """
    return 0.5 + 0.5 * np.cos(np.pi * min(max((d - d1) / (d2 - d1), 0.0), 1.0))


@compiled
def _rate_of_eq10(x: Any, i: int, d: float) -> float:
    """Compute the distance rate of near pair i by eq. 10 with the consistent bracket [m/s].

    Undamped, and for J_d N != 0, J_d q̇ is (1 - β)(1 - α) min(u, ẋ0) + β ẋ0, with u = J v_tracking + ḋ_obs and α for u
    < 0 only. As a lower bound it asks of a pair that separates by itself for no more than ẋ0. α > 1 asks a pair that
    closes to separate: of two bodies of the robot, as of neighbouring links, the cap is 1, so that for ẋ0 = 0 rest
    meets all of them.

    Args:
        x: reads J, v_tracking, feedforward, d1, d2, alpha_cap, retreat_speed, margin, near_pairs, twist_row.
        i: number of the near pair.
        d: its distance [m].
    """
    u = x.feedforward[i]
    for c in range(len(x.v_tracking)):
        u += x.J[i, c] * x.v_tracking[c]
    rate, weight = min(u, x.retreat_speed), beta(d, x.d1, x.d2)
    if u < 0.0:
        own = x.twist_row[x.near_pairs[i]] == len(x.margin) - 1
        rate *= 1.0 - min(alpha(d, x.d2), min(x.alpha_cap, OWN_ALPHA_CAP) if own else x.alpha_cap)
    return (1.0 - weight) * rate + weight * x.retreat_speed


@compiled
def _jerk_limited_closing(x: Any, i: int, rate: float, step: float, clearance: float) -> float:
    """Compute the row bound at which closing pair i can stop within jerk limits, too.

    A share of the joints' jerks, all at work on the pair, brings it to rest within the distance. The closing speed
    of the previous step, -(J v_prev + ḋ_obs), and its change, -J dv_prev, are braked as a coordinate is within jerk
    limits: see `kernels.braking_bounds`.

    Args:
        x: reads J, feedforward, v_prev, dv_prev, dv_step.
        i: number of the near pair.
        rate: its bound so far [m/s]; all jerks at work on a pair change the change of its speed no more than this.
        step: change of the closing speed that a share of the joints' accelerations makes in a step [m/s].
        clearance: distance above the safety distance over the control period [m/s].

    Returns:
        Bound [m/s]; -∞ where the jerks of its joints have no limit.
    """
    speed, change, unit = -x.feedforward[i], 0.0, 0.0
    for c in range(len(x.v_prev)):
        if x.J[i, c] != 0.0:
            speed -= x.J[i, c] * x.v_prev[c]
            change -= x.J[i, c] * x.dv_prev[c]
            unit += abs(x.J[i, c]) * x.dv_step[c]
    unit *= BRAKING_FRACTION
    if not 0.0 < unit < np.inf:
        return -np.inf
    high = min((-rate - speed) / unit, change / unit + 1.0 / BRAKING_FRACTION)
    change = _change_to_stop(speed / unit, high, -np.inf, step / unit, clearance / unit)
    return -speed - unit * change
