"""The torque level: what mass matrix, bias torques and gravity make of the rows, bounds and velocity of a control step.

With the measured velocity v0, M (v - v0) / dt + h = τ makes torque limits rows in v. All else stays as it is at
velocity level, but for the acceleration on which braking counts, and the rates at which tracking and rows are
approached: see docs/dynamics.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.bounds import OUTSIDE, velocity_bounds
from qpavoid.kernels.braking_trajectory import stop_velocity
from qpavoid.kernels.cholesky import factorise, solve_factored
from qpavoid.kernels.clearance import is_clear
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.qp import project, project_soft
from qpavoid.kernels.rows import distance_rows, row_bounds
from qpavoid.kernels.step import SETTLED, TO_MEASURE, UNSETTLED, _is_too_near, find_near_pairs, violation
from qpavoid.kernels.tasks import frame_rows
from qpavoid.kernels.tracking_law import tracking_law
from qpavoid.problem import Array, IntArray, Mask

LEAST_SCALE = 0.02
"""Least scale of the accelerations on which braking counts [-]: bounds need some."""
HOLDING_GAIN = 5.0
"""ξ_g: share per time of what gravity may still take of a torque that it takes at the most [1/s]."""
BOUND_SOFTNESS = 1e-6
"""Softness of bounds that rows may pass [(m/s)² per unit of the cost]: so little that nothing else is worth it."""
ROW_TOLERANCE = 1e-6
"""By how much torque rows are narrower than the limits [rad/s or m/s]: what a back end may violate them by."""


class DynamicsArrays(NamedTuple):
    """Memory of the torque level of a step: n coordinates, a of them actuated, m rows of torques and holding."""

    M: Array
    """(n, n) mass matrix; its upper triangle is read."""
    h: Array
    """(n,) bias torques: Coriolis, centrifugal, gravity [Nm or N]."""
    gravity: Array
    """(n,) the part of gravity [Nm or N]."""
    gravity_slope: Array
    """(n, n) ∂gravity/∂q."""
    actuated: IntArray
    """(a,) coordinates with a motor."""
    limit: Array
    """(a,) largest torque in either direction, infinite without one [Nm or N]."""
    acceleration: Array
    """(n,) largest acceleration on which braking may count [rad/s² or m/s²]."""
    acceleration_step: Array
    """(n,) largest change of v in a step that rows do not need, infinite without any [rad/s or m/s]."""
    braking: Array
    """(n,) out: acceleration on which braking counts here [rad/s² or m/s²]."""
    rows: Array
    """(m + pairs, n) out: rows of torques, of holding, then of the near pairs."""
    rhs: Array
    """(m + pairs,) out: their right-hand sides."""
    torque: Array
    """(a,) out: of the velocity of the last step [Nm or N]."""
    change: Array
    """(n,) out: acceleration of the last step [rad/s² or m/s²]."""
    factor: Array
    """(n, n) scratch."""
    approaches: Mask
    """(1,) whether v_tracking is approached at `tracking_factor`, or taken as it is."""
    has_torques: bool
    """Whether torques have limits."""
    mirrors: bool
    """Whether the lower triangle of M is that of the upper one; else rows of M are as they are."""
    has_holding: bool
    """Whether there are rows of holding."""
    braking_fraction: float
    """Share of the torques on which braking counts [-]."""
    holding_fraction: float
    """η: share of the torques that gravity may take [-]."""
    tracking_factor: float
    """κ: part of the change to the tracked velocity that one step makes [-]."""
    row_factor: float
    """κ_r: the same of the velocities that rows ask for [-]."""


@compiled
def dynamics_step(
    x: Any, y: Any, q: Array, influence_distance: float, moving: bool, from_tasks: bool, is_measured: bool
) -> int:
    """Compute a control step of the torque level; see `control_step`, of which it is the counterpart.

    Args:
        x: memory of the step; see `RowLayout`.
        y: `DynamicsArrays`, with M, h, gravity and gravity_slope of q and x.v_prev, the measured velocity.
        q: configuration (nq,).
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.
        from_tasks: whether the tasks are followed, or v_tracking as it is.
        is_measured: whether kinematics and distances are up to date.

    Returns:
        See `control_step`.
    """
    if not is_measured:
        _, _, meeting = find_near_pairs(x, q)
        if meeting > 0:
            return TO_MEASURE
    s, n, m = x.summary[0], len(x.v_prev), len(y.rhs) - len(x.rhs)
    if y.mirrors:
        for i in range(n):
            for j in range(i):
                y.M[i, j] = y.M[j, i]
    scale_braking(x, y)
    margin, bent = velocity_bounds(x, q), 0.0
    admit_stop(x, y)
    if from_tasks:
        frame_rows(x)
        bent = tracking_law(x, x.A, x.b, x.v_tracking, x.b_feasible)
        if x.task_switching:
            bent = 0.0
    k = distance_rows(x, x.distances.rows[: x.distances.counts[1]], influence_distance, moving)
    stop = x.v_stop.copy()
    if y.has_torques:  # rows ask for more than the straight stop gives, where they have to
        x.v_stop[:] = 0.0
    row_bounds(x, k, moving)
    x.v_stop[:] = stop
    slow_rows(x, y, k)
    if y.approaches[0]:
        for j in range(n):
            x.v_tracking[j] = x.v_prev[j] + y.tracking_factor * (x.v_tracking[j] - x.v_prev[j])
    if y.has_torques:
        torque_rows(x, y)
    if y.has_holding:
        holding_rows(x, y)
    y.rows[m : m + k], y.rhs[m : m + k] = x.J[:k], x.rhs[:k]
    G, g = y.rows[: m + k], y.rhs[: m + k]
    worst = violation(x.v_tracking, G, g, x.lower, x.upper)
    is_tracking_clear = x.looks_ahead and worst <= 0.0 and is_clear(x, q, x.v_tracking, k, influence_distance)
    s.rows, s.violation, s.is_clear, s.position_margin, s.bent = k, worst, is_tracking_clear, margin, bent
    if x.regularization == 0.0 or not x.looks_ahead or margin < -OUTSIDE:
        return UNSETTLED
    if worst <= 0.0:
        x.v[:] = x.v_tracking
        return SETTLED if is_tracking_clear else UNSETTLED
    if _is_too_near(x, k):
        return UNSETTLED
    A, regularization = x.A if from_tasks else x.identity, max(x.regularization, bent)
    v, is_solved = project(A, regularization, x.v_tracking, G, g, x.lower, x.upper)
    if not is_solved:
        v, is_solved = project_widened(
            A, regularization, x.v_tracking, G, g, x.lower, x.upper, x.hard_lower, x.hard_upper
        )
    x.v[:] = v
    return SETTLED if is_solved and is_clear(x, q, v, k, influence_distance) else UNSETTLED


@compiled
def project_widened(
    A: Array, regularization: float, v_tracking: Array, J: Array, b: Array, lower: Array, upper: Array,
    hard_lower: Array, hard_upper: Array,
) -> tuple[Array, bool]:  # fmt: skip
    """Compute `project` with bounds that are passed as little as rows need, within the hard ones.

    Rows come before accelerations here: where a model is wrong, it takes more of them to brake.

    Args:
        A: tracking rows (r, n).
        regularization: λ.
        v_tracking: velocity of least cost (n,) [rad/s or m/s].
        J: rows (k, n).
        b: their right-hand sides (k,).
        lower: lower bounds (n,) [rad/s or m/s].
        upper: upper bounds (n,) [rad/s or m/s].
        hard_lower: those that are never passed (n,) [rad/s or m/s].
        hard_upper: the same above (n,).

    Returns:
        See `project_soft`.
    """
    k, n = J.shape
    G, g, soft = np.zeros((k + 2 * n, n)), np.empty(k + 2 * n), np.zeros(k + 2 * n)
    G[:k], g[:k], soft[k:] = J, b, BOUND_SOFTNESS
    for j in range(n):
        G[k + j, j], g[k + j] = 1.0, lower[j]
        G[k + n + j, j], g[k + n + j] = -1.0, -upper[j]
    return project_soft(A, regularization, v_tracking, G, g, hard_lower, hard_upper, soft)


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


@compiled
def inverse_dynamics(y: Any, v: Array, v_measured: Array, dt: float) -> float:
    """Compute acceleration and torques that lead to a velocity: a = (v - v0) / dt, τ = (M a + h)_a.

    Args:
        y: reads M, h, limit; writes change and torque.
        v: velocity at the end of the period (n,) [rad/s or m/s].
        v_measured: v0 (n,).
        dt: control period [s].

    Returns:
        Largest excess of a torque over its limit, negative within [Nm or N].
    """
    excess = -np.inf
    for j in range(len(v)):
        y.change[j] = (v[j] - v_measured[j]) / dt
    for r in range(len(y.actuated)):
        i = y.actuated[r]
        torque = y.h[i]
        for j in range(len(v)):
            torque += y.M[i, j] * y.change[j]
        y.torque[r] = torque
        excess = max(excess, abs(torque) - y.limit[r])
    return excess


@compiled
def forward_dynamics(y: Any) -> None:
    """Cut the torques at their limits, and compute the acceleration that follows, where all coordinates are actuated.

    Args:
        y: reads M, h, limit; changes torque, writes change.
    """
    n = len(y.h)
    change = np.empty(n)
    for r in range(n):
        y.torque[r] = min(max(y.torque[r], -y.limit[r]), y.limit[r])
        change[y.actuated[r]] = y.torque[r] - y.h[y.actuated[r]]
    factorise(y.M, y.factor, n)
    solve_factored(y.factor, change, y.change, n)
