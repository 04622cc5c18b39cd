"""A control step in one call: from a configuration to a velocity that may be commanded, where that is simple."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import OUTSIDE, velocity_bounds
from qpavoid.kernels.braking_trajectory import stop_velocity
from qpavoid.kernels.clearance import is_clear
from qpavoid.kernels.kinematics import update_kinematics
from qpavoid.kernels.near_pairs import near_pairs, place_bodies
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.qp import project
from qpavoid.kernels.rows import distance_rows, row_bounds
from qpavoid.kernels.tasks import frame_rows
from qpavoid.kernels.tracking_law import tracking_law
from qpavoid.problem import Array, IntArray

TOLERATED_DEPTH = 1e-3
"""Depth below the safety distance [m], or excess over a position limit [rad or m], that slows nothing down: noise and
control periods lead that far."""
SETTLED, UNSETTLED, TO_MEASURE, UNCLEAR, TO_SOLVE = range(5)
"""What `control_step` returns, and TO_SOLVE where it solves its QP first."""


@compiled
def find_near_pairs(x: Any, q: Array, influence_distance: float) -> tuple[int, int, int]:
    """Compute kinematics and the distances of the near pairs that coal is not needed for.

    Args:
        x: memory of the step; see `RowLayout`.
        q: configuration (nq,).
        influence_distance: surface distance below which a pair is near [m].

    Returns:
        What `near_pairs` returns.
    """
    update_kinematics(x.kinematics, q)
    place_bodies(x.distances, x.joint_poses)
    return near_pairs(x.distances, influence_distance)


@compiled
def control_step(x: Any, q: Array, influence_distance: float, moving: bool, from_tasks: bool, is_measured: bool) -> int:
    """Compute a control step: kinematics, distances, rows and bounds, and the QP with its stop look-ahead.

    Args:
        x: memory of the step; its outputs are overwritten, see `RowLayout`.
        q: configuration (nq,).
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.
        from_tasks: whether the tasks are followed, or v_tracking as it is.
        is_measured: whether kinematics and distances are up to date.

    Returns:
        SETTLED where `v` may be commanded as it is; UNCLEAR where that needs a look ahead, and nothing else; UNSETTLED
        where other laws and checks decide; TO_MEASURE where the distances of some near pairs have to be computed by
        other means first.
    """
    if not is_measured:
        _, _, meeting = find_near_pairs(x, q, influence_distance)
        if meeting > 0:
            return TO_MEASURE
    pairs, s = x.distances.rows[: x.distances.counts[1]], x.summary[0]
    k, worst, is_tracking_clear, margin, bent = assemble(x, q, pairs, influence_distance, moving, from_tasks)
    s.rows, s.violation, s.is_clear, s.position_margin, s.bent = k, worst, is_tracking_clear, margin, bent
    code = settle_tracking(x, k)
    if code != TO_SOLVE:
        return code
    A = x.A if from_tasks else x.identity
    v, is_solved = project(A, max(x.regularization, bent), x.v_tracking, x.J[:k], x.rhs[:k], x.lower, x.upper)
    x.v[:] = v
    if not is_solved:
        return UNSETTLED
    return SETTLED if is_clear(x, q, v, k, influence_distance) else UNCLEAR


@compiled
def settle_tracking(x: Any, k: int) -> int:
    """Write v where the tracked velocity may be commanded; return whether it may, or what decides instead.

    Args:
        x: memory of a step, with its `SUMMARY`.
        k: number of near pairs.
    """
    s = x.summary[0]
    if x.regularization == 0.0 or not x.looks_ahead or s.position_margin < -OUTSIDE:
        return UNSETTLED
    if s.violation <= 0.0:
        x.v[:] = x.v_tracking
        if s.is_clear:
            return SETTLED
        return UNSETTLED if is_too_near(x, k) else UNCLEAR
    return UNSETTLED if is_too_near(x, k) else TO_SOLVE


@compiled
def is_too_near(x: Any, k: int) -> bool:
    """Return True if any of the first k pairs is so near that the robot has to recover, or if that is unknown."""
    nearest = np.inf
    for i in range(k):
        nearest = np.minimum(nearest, x.d[i])  # keeps NaN, unlike min
    return not nearest >= x.d1 - TOLERATED_DEPTH


@compiled
def assemble(
    x: Any, q: Array, pairs: IntArray, influence_distance: float, moving: bool, from_tasks: bool
) -> tuple[int, float, bool, float, float]:
    """Write all rows and bounds of a control step, and the tracking law's velocity.

    Args:
        x: memory of the step; its outputs are overwritten, see `RowLayout`.
        q: configuration (nq,).
        pairs: those whose results are of this step (c,), increasing.
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.
        from_tasks: whether the tasks are followed, or v_tracking as it is.

    Returns:
        The numbers of `SUMMARY`.
    """
    margin, bent = velocity_bounds(x, q), 0.0
    stop_velocity(x)
    if from_tasks:
        frame_rows(x)
        bent = tracking_law(x, x.A, x.b, x.v_tracking, x.b_feasible)
        if x.task_switching:  # rows are compared with eq. 10 at a λ that is the same in every step
            bent = 0.0
    k = distance_rows(x, pairs, influence_distance, moving)
    row_bounds(x, k, moving)
    worst = tracking_violation(x, k)
    clear = x.looks_ahead and worst <= 0.0 and is_clear(x, q, x.v_tracking, k, influence_distance)
    return k, worst, clear, margin, bent


@compiled
def tracking_violation(x: Any, k: int) -> float:
    """Compute the `violation` by v_tracking of the first k rows and the bounds [m/s, rad/s].

    Args:
        x: reads v_tracking, J, rhs, lower and upper.
        k: number of near pairs.
    """
    return violation(x.v_tracking, x.J[:k], x.rhs[:k], x.lower, x.upper)


@compiled
def violation(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """Compute the largest violation of J v >= b and lower <= v <= upper by v [m/s, rad/s].

    Args:
        v: velocity (n,).
        J: rows (k, n).
        b: right-hand sides (k,).
        lower: lower bounds (n,).
        upper: upper bounds (n,).

    Returns:
        max(b - J v, v - upper, lower - v): negative inside, NaN where there is one.
    """
    worst = -np.inf
    for i in range(len(v)):
        worst = np.maximum(worst, np.maximum(v[i] - upper[i], lower[i] - v[i]))  # keeps NaN, unlike max
    for k in range(len(b)):
        missing = b[k]
        for i in range(len(v)):
            missing -= J[k, i] * v[i]
        worst = np.maximum(worst, missing)
    return worst
