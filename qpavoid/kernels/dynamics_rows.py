"""Rows and bounds of the torque level: torque limits, gravity that is held, braking within torques, finite rates."""

from __future__ import annotations

from typing import Any

from qpavoid.kernels.braking_trajectory import stop_velocity
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rows import distance_rows, row_bounds

LEAST_SCALE = 0.02
"""Least scale of the accelerations on which braking counts [-]: bounds need some."""
HOLDING_GAIN = 5.0
"""ξ_g: share per time of what gravity may still take of a torque that it takes at the most [1/s]."""
ROW_TOLERANCE = 1e-6
"""By how much torque rows are narrower than the limits [rad/s or m/s]: what a back end may violate them by."""


@compiled
def scale_braking(x: Any, y: Any) -> None:
    """Write the accelerations on which braking counts here: the largest scale s of all whose box the torques cover.

    With a share of the torques, room_i = min(share τ_i - h_i, share τ_i + h_i), s = min room_i / Σ_j |M_ij| a_j: any
    accelerations within s a then need no more torque than that. s is at least `LEAST_SCALE`, and at most 1.

    Args:
        x: writes v_step.
        y: reads M, h, limit, acceleration; writes braking.
    """
    scale = 1.0
    if y.has_torques:
        for r in range(len(y.actuated)):
            i, needed = y.actuated[r], 0.0
            for j in range(len(y.acceleration)):
                needed += abs(y.M[i, j]) * y.acceleration[j]
            left = y.braking_fraction * y.limit[r] - abs(y.h[i])
            scale = min(scale, left / needed)
        scale = max(scale, LEAST_SCALE)
    for j in range(len(y.acceleration)):
        y.braking[j] = scale * y.acceleration[j]
        x.v_step[j] = x.dt * y.braking[j]


@compiled
def stopping_factor(x: Any, y: Any) -> float:
    """Compute σ in [0, 1]: the largest part of the measured velocity that the torques can take away in a step.

    Args:
        x: reads v_prev.
        y: reads M, h, limit.
    """
    factor = 1.0
    if y.has_torques:
        for r in range(len(y.actuated)):
            i, momentum, weight = y.actuated[r], 0.0, 0.0
            for j in range(len(x.v_prev)):
                momentum += y.M[i, j] * x.v_prev[j]
                weight += abs(y.M[i, j])
            left = y.limit[r] - ROW_TOLERANCE * weight / x.dt
            left += y.h[i] if momentum > 0.0 else -y.h[i]
            if momentum != 0.0:
                factor = min(factor, max(left, 0.0) * x.dt / abs(momentum))
    return factor


@compiled
def admit_stop(x: Any, y: Any) -> None:
    """Let the hard bounds of a step admit the straight stop, (1 - σ) times the measured velocity, and write v_stop.

    So there is always something between them and the torque limits. lower and upper, which a law keeps to where rows
    let it, are as tight as ever, and contain the accelerations. Those that ask a coordinate to return from outside its
    position limits are approached at the rate of rows, and no slower than it can brake.

    The stop takes away what braking counts on or, where that is more, what the rate of rows does, as far as torques
    let it. With jerk limits, bounds and stop are those of the velocity level.

    Args:
        x: reads v_prev and v_step; writes hard_lower, hard_upper, lower, upper and v_stop (n,) [rad/s or m/s].
        y: reads M, h, limit, acceleration_step.
    """
    v, factor, steps = x.v_prev, stopping_factor(x, y), 1.0
    for j in range(len(v)):
        low, high, step = x.hard_lower[j], x.hard_upper[j], x.v_step[j]
        if low > 0.0:
            low = min(low, v[j] + max(y.row_factor * (low - v[j]), min(step, -v[j])))
            x.lower[j] = min(x.lower[j], low)
        if high < 0.0:
            high = max(high, v[j] + min(y.row_factor * (high - v[j]), max(-step, -v[j])))
            x.upper[j] = max(x.upper[j], high)
        if not x.jerk_limited:
            change = y.acceleration_step[j]
            x.lower[j], x.upper[j] = min(max(v[j] - change, low), high), max(min(v[j] + change, high), low)
        if y.has_torques:
            x.hard_lower[j], x.hard_upper[j] = min(low, (1.0 - factor) * v[j]), max(high, (1.0 - factor) * v[j])
        steps = max(steps, abs(v[j]) / step)
    if x.jerk_limited:
        stop_velocity(x)
        return
    if y.has_torques:
        factor = min(factor, max(1.0 / steps, y.row_factor))
    else:
        factor = 1.0 / steps if x.acceleration_limited else 1.0
    for j in range(len(v)):
        x.v_stop[j] = (1.0 - factor) * v[j]
        if not y.has_torques:
            x.v_stop[j] = min(max(x.v_stop[j], x.lower[j]), x.upper[j])


@compiled
def approached_rows(x: Any, y: Any, influence_distance: float, moving: bool) -> int:
    """Write the rows of the near pairs, approached at a finite rate; return their number.

    Args:
        x: memory of the step, with the distances of the near pairs.
        y: reads has_torques and row_factor.
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.
    """
    k = distance_rows(x, x.distances.rows[: x.distances.counts[1]], influence_distance, moving)
    stop = x.v_stop.copy()
    if y.has_torques:  # rows ask for more than the straight stop gives, where they have to
        x.v_stop[:] = 0.0
    row_bounds(x, k, moving)
    x.v_stop[:] = stop
    slow_rows(x, y, k)
    return k


@compiled
def slow_rows(x: Any, y: Any, k: int) -> None:
    """Approach the first k avoidance rows at a finite rate: J v >= J v0 + κ_r (b - J v0).

    With b = -ξ h of a damper, that is J a >= -α2 (ḣ + ξ h), a row of relative degree two.

    Args:
        x: reads J and v_prev; writes rhs and rhs_contact (k,) [m/s].
        y: reads row_factor.
        k: number of near pairs.
    """
    if y.row_factor >= 1.0:
        return
    for i in range(k):
        rate = 0.0
        for j in range(len(x.v_prev)):
            rate += x.J[i, j] * x.v_prev[j]
        x.rhs[i] = rate + y.row_factor * (x.rhs[i] - rate)
        x.rhs_contact[i] = rate + y.row_factor * (x.rhs_contact[i] - rate)


@compiled
def torque_rows(x: Any, y: Any) -> None:
    """Write the rows of the torque limits: M_a v within M_a v0 + dt (±τ - h_a), over the sum of |M_a|.

    Args:
        x: reads v_prev.
        y: reads M, h, limit; writes the first 2 a rows.
    """
    for r in range(len(y.actuated)):
        i, weight, momentum = y.actuated[r], 0.0, 0.0
        for j in range(len(x.v_prev)):
            weight += abs(y.M[i, j])
            momentum += y.M[i, j] * x.v_prev[j]
        for j in range(len(x.v_prev)):
            y.rows[2 * r, j] = y.M[i, j] / weight
            y.rows[2 * r + 1, j] = -y.M[i, j] / weight
        middle = momentum - x.dt * y.h[i]
        y.rhs[2 * r] = (middle - x.dt * y.limit[r]) / weight + ROW_TOLERANCE
        y.rhs[2 * r + 1] = (-middle - x.dt * y.limit[r]) / weight + ROW_TOLERANCE


@compiled
def holding_rows(x: Any, y: Any) -> None:
    """Write the rows that keep gravity within a share η of the torques: ∓∂g/∂q v >= -ξ_g (η τ ∓ g), over τ.

    They are approached at the rate of rows, as all others are.

    Args:
        x: reads v_prev.
        y: reads gravity, gravity_slope, limit; writes the 2 a rows after those of the torques.
    """
    count = len(y.actuated)
    for r in range(count):
        i, rate = y.actuated[r], 0.0
        first, second = 2 * (count + r), 2 * (count + r) + 1
        for j in range(len(x.v_prev)):
            slope = y.gravity_slope[i, j] / y.limit[r]
            rate += slope * x.v_prev[j]
            y.rows[first, j], y.rows[second, j] = -slope, slope
        taken = y.gravity[i] / y.limit[r]
        first_rhs, second_rhs = (
            -HOLDING_GAIN * (y.holding_fraction - taken),
            -HOLDING_GAIN * (y.holding_fraction + taken),
        )
        y.rhs[first] = -rate + y.row_factor * (first_rhs + rate)
        y.rhs[second] = rate + y.row_factor * (second_rhs - rate)
