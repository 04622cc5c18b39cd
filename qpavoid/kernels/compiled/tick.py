"""`kernels.vectorised.tick` as loops that numba compiles; documented there."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.compiled.ahead import tracking_clear
from qpavoid.kernels.compiled.bounds import velocity_bounds
from qpavoid.kernels.compiled.frames import damped_solution, frame_rows
from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.compiled.pairs import distance_rows, row_bounds
from qpavoid.kernels.compiled.stops import stop_velocity
from qpavoid.problem import Array, IntArray


@compiled
def assemble(x: Any, q: Array, pairs: IntArray, reach: float, moving: bool) -> tuple[int, float, bool, float]:
    """See `vectorised.tick.assemble`."""
    frame_rows(x)
    room = velocity_bounds(x, q)
    stop_velocity(x)
    damped_solution(x, x.v0)
    k = distance_rows(x, pairs, reach, moving)
    row_bounds(x, k, moving)
    worst = tracking_shortfall(x, k)
    clear = x.looks_ahead and worst <= 0.0 and tracking_clear(x, q, k, reach)
    return k, worst, clear, room


@compiled
def tracking_shortfall(x: Any, k: int) -> float:
    """See `vectorised.tick.tracking_shortfall`."""
    return shortfall(x.v0, x.J[:k], x.least[:k], x.lower, x.upper)


@compiled
def shortfall(v: Array, J: Array, b: Array, lower: Array, upper: Array) -> float:
    """See `vectorised.tick.shortfall`."""
    worst = -np.inf
    for i in range(len(v)):
        worst = np.maximum(worst, np.maximum(v[i] - upper[i], lower[i] - v[i]))  # keeps NaN, unlike max
    for k in range(len(b)):
        short = b[k]
        for i in range(len(v)):
            short -= J[k, i] * v[i]
        worst = np.maximum(worst, short)
    return worst
