"""All rows and bounds of a control step in one call, and the violation of them by the tracking law."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.braking_trajectory import stop_velocity
from qpavoid.kernels.clearance import is_tracking_clear
from qpavoid.kernels.kinematics import update_kinematics
from qpavoid.kernels.near_pairs import near_pairs, place_bodies
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rows import distance_rows, row_bounds
from qpavoid.kernels.tasks import frame_rows
from qpavoid.kernels.tracking_law import tracking_law
from qpavoid.problem import Array, IntArray


@compiled
def find_near_pairs(x: Any, q: Array) -> tuple[int, int, int]:
    """Compute kinematics and the distances of the near pairs that have a closed form.

    Args:
        x: memory of the step; see `RowLayout`.
        q: configuration (nq,).

    Returns:
        What `near_pairs` returns.
    """
    update_kinematics(x.kinematics, q)
    place_bodies(x.distances, x.joint_poses)
    return near_pairs(x.distances)


@compiled
def control_step(
    x: Any, q: Array, influence_distance: float, moving: bool
) -> tuple[int, int, int, int, float, bool, float, float]:
    """Compute kinematics, distances and all rows and bounds of a control step.

    Args:
        x: memory of the step; see `RowLayout`.
        q: configuration (nq,).
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.

    Returns:
        What `near_pairs` returns, then what `assemble` does.
    """
    near, rows, meeting = find_near_pairs(x, q)
    k, worst, clear, margin, bent = assemble(x, q, x.distances.rows[:rows], influence_distance, moving)
    return near, rows, meeting, k, worst, clear, margin, bent


@compiled
def assemble(
    x: Any, q: Array, pairs: IntArray, influence_distance: float, moving: bool
) -> tuple[int, float, bool, float, float]:
    """Write all rows and bounds of a control step, and the tracking law's velocity.

    Args:
        x: memory of the step; its outputs are overwritten, see `RowLayout`.
        q: configuration (nq,).
        pairs: those whose results are of this step (c,), increasing.
        influence_distance: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.

    Returns:
        Number k of near pairs; largest violation of rows and bounds by the tracking law's velocity [m/s, rad/s]
        (negative inside, NaN where there is one); whether that velocity is safe, its clearance is bounded
        (`looks_ahead`) and the bound suffices; distance to the nearest position limit [rad, m]; how far the task rows
        bend within the step, see `tracking_law`.
    """
    frame_rows(x)
    margin = velocity_bounds(x, q)
    stop_velocity(x)
    bent = tracking_law(x, x.A, x.b, x.v_tracking, x.b_feasible)
    k = distance_rows(x, pairs, influence_distance, moving)
    row_bounds(x, k, moving)
    worst = tracking_violation(x, k)
    clear = x.looks_ahead and worst <= 0.0 and is_tracking_clear(x, q, k, influence_distance)
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
