"""The torque level: what mass matrix, bias torques and gravity make of the rows, bounds and velocity of a control step.

With the measured velocity v0, M (v - v0) / dt + h = τ makes torque limits rows in v. All else stays as it is at
velocity level, but for the acceleration on which braking counts, and the rates at which tracking and rows are
approached: see docs/dynamics.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.cholesky import factorise, solve_factored
from qpavoid.kernels.clearance import is_clear
from qpavoid.kernels.dynamics_rows import admit_stop, approached_rows, holding_rows, scale_braking, torque_rows
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.qp import project, project_soft
from qpavoid.kernels.step import (
    SETTLED,
    TO_MEASURE,
    TO_SOLVE,
    UNSETTLED,
    find_near_pairs,
    settle_tracking,
    violation,
)
from qpavoid.kernels.tasks import frame_rows
from qpavoid.kernels.tracking_law import tracking_law
from qpavoid.problem import Array, IntArray, Mask

BOUND_SOFTNESS = 1e-6
"""Softness of bounds that rows may pass [(m/s)² per unit of the cost]: so little that nothing else is worth it."""


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
        _, _, meeting = find_near_pairs(x, q, influence_distance)
        if meeting > 0:
            return TO_MEASURE
    s, n, m = x.summary[0], len(x.v_prev), len(y.rhs) - len(x.rhs)
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
    k = approached_rows(x, y, influence_distance, moving)
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
    code = settle_tracking(x, k)
    if code != TO_SOLVE:
        return code
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
