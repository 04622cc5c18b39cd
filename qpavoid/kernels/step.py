"""All rows and bounds of a tick in one call, and whether the tracking law meets them."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.clearance import tracking_clear
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rows import distance_rows, row_bounds
from qpavoid.kernels.stops import stop_velocity
from qpavoid.kernels.tasks import damped_solution, frame_rows
from qpavoid.problem import Array, IntArray


@compiled
def assemble(x: Any, q: Array, pairs: IntArray, reach: float, moving: bool) -> tuple[int, float, bool, float]:
    """Write all rows and bounds of a tick, and the tracking law's velocity.

    Args:
        x: memory of the tick; its outputs are overwritten.
        q: configuration (nq,).
        pairs: those whose results are of this tick (c,), increasing.
        reach: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.

    Returns:
        Number k of near pairs; by how much the tracking law's velocity violates the worst of rows and bounds
        (negative inside, NaN where there is one); whether it is safe, checked, and its way surely clear; distance
        to the nearest position limit [rad, m].
    """
    frame_rows(x)
    room = velocity_bounds(x, q)
    stop_velocity(x)
    damped_solution(x, x.v_tracking)
    k = distance_rows(x, pairs, reach, moving)
    row_bounds(x, k, moving)
    worst = tracking_violation(x, k)
    clear = x.looks_ahead and worst <= 0.0 and tracking_clear(x, q, k, reach)
    return k, worst, clear, room


@compiled
def tracking_violation(x: Any, k: int) -> float:
    """Compute `violation` of v0, with the first k rows."""
    return violation(x.v_tracking, x.J[:k], x.least[:k], x.lower, x.upper)


@compiled
def violation(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """Compute the largest violation of J v >= b and lower <= v <= upper; negative inside, NaN where there is one."""
    worst = -np.inf
    for i in range(len(v)):
        worst = np.maximum(worst, np.maximum(v[i] - upper[i], lower[i] - v[i]))  # keeps NaN, unlike max
    for k in range(len(b)):
        short = b[k]
        for i in range(len(v)):
            short -= J[k, i] * v[i]
        worst = np.maximum(worst, short)
    return worst
