"""All rows and bounds of a tick in one call, and whether the tracking law meets them."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.vectorised.ahead import tracking_clear
from qpavoid.kernels.vectorised.bounds import velocity_bounds
from qpavoid.kernels.vectorised.frames import damped_solution, frame_rows
from qpavoid.kernels.vectorised.pairs import distance_rows, row_bounds
from qpavoid.kernels.vectorised.stops import stop_velocity
from qpavoid.problem import Array, IntArray


def assemble(x: Any, q: Array, pairs: IntArray, reach: float, moving: bool) -> tuple[int, float, bool, float]:
    """All rows and bounds of a tick, and the tracking law's velocity.

    Args:
        x: memory of the tick; its outputs are overwritten.
        q: configuration (nq,).
        pairs: those whose results are of this tick (c,), increasing.
        reach: surface distance below which a pair is near [m].
        moving: whether any obstacle moves.

    Returns:
        Number k of near pairs; by how much the tracking law's velocity violates the worst of rows and bounds
        (negative inside, NaN where there is one); whether it is safe, looked at, and its way surely clear; room
        left to the nearest position limit [rad, m].
    """
    frame_rows(x)
    room = velocity_bounds(x, q)
    stop_velocity(x)
    damped_solution(x, x.v0)
    k = distance_rows(x, pairs, reach, moving)
    if k:
        row_bounds(x, k, moving)
    worst = tracking_shortfall(x, k)
    clear = x.looks_ahead and worst <= 0.0 and tracking_clear(x, q, k, reach)
    return k, worst, clear, room


def tracking_shortfall(x: Any, k: int) -> float:
    """`shortfall` of v0, with the first k rows."""
    v, rows = x.v0, x.rows(k)
    np.subtract(v, x.upper, out=x.over_upper)
    np.subtract(x.lower, v, out=x.over_lower)
    if k:
        np.dot(rows.J, v, out=rows.outside)
        np.subtract(rows.least, rows.outside, out=rows.outside)
    return float(rows.over.max())


def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """Largest violation of J v >= b and lower <= v <= upper; negative inside, NaN where there is one."""
    over = np.maximum(v - upper, lower - v).max()
    if len(b):
        outside = (b - np.dot(J, v)).max()
        if not (over >= outside or over != over):
            return float(outside)
    return float(over)
