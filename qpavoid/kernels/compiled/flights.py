"""`kernels.vectorised.flights` as loops that numba compiles; documented there."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.compiled.bounds import velocity_bounds
from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.compiled.pairs import distance_rows
from qpavoid.kernels.vectorised.flights import ROUND_OFF
from qpavoid.problem import Array, IntArray, Mask


@compiled
def look_around(
    x: Any, q: Array, pairs: IntArray, reach: float, moving: bool, watched: Mask, touch: float
) -> tuple[int, int, float, float]:
    """See `vectorised.flights.look_around`."""
    velocity_bounds(x, q)
    k = distance_rows(x, pairs, reach, moving)
    n, touching, nearest, rest = 0, 0, reach, reach
    for i in range(k):
        if not watched[x.near[i]]:
            continue
        distance, slack = x.closest[i, 0], x.slack[x.near[i]]
        nearest = np.minimum(nearest, distance + slack)  # keeps NaN, unlike min
        if not distance >= touch:
            watched[x.near[i]] = False
            touching += 1
            continue
        rest = min(rest, distance + slack)
        if n < i:
            x.near[n], x.drift[n] = x.near[i], x.drift[i]
            for c in range(10):
                x.closest[n, c] = x.closest[i, c]
            for c in range(x.J.shape[1]):
                x.J[n, c] = x.J[i, c]
        n += 1
    return n, touching, nearest, rest


@compiled
def comes_too_near(closest: Array, J: Array, drift: Array, v: Array, span: float, safe: float) -> bool:
    """See `vectorised.flights.comes_too_near`."""
    for i in range(len(drift)):
        rate = drift[i]
        for c in range(len(v)):
            rate += J[i, c] * v[c]
        if closest[i, 0] + span * rate < safe:
            return True
    return False


@compiled
def ramp(v: Array, wanted: Array, v_step: Array, meets: bool) -> Array:
    """See `vectorised.flights.ramp`."""
    steps, before = np.empty(wanted.shape), v
    for k in range(len(wanted)):
        off = 0.0
        for c in range(len(v)):
            steps[k, c] = before[c] + min(max(wanted[k, c] - before[c], -v_step[c]), v_step[c])
            off = max(off, abs(steps[k, c] - wanted[k, c]))
        if meets and off < ROUND_OFF:
            return steps[: k + 1]
        before = steps[k]
    return steps


@compiled
def least_apart(paths: Array, centers: Array, sizes: Array) -> float:
    """See `vectorised.flights.least_apart`."""
    least = np.inf
    for o in range(paths.shape[1]):
        for b in range(len(centers)):
            nearest = np.inf
            for t in range(len(paths)):
                x, y, z = paths[t, o, 0] - centers[b, 0], paths[t, o, 1] - centers[b, 1], paths[t, o, 2] - centers[b, 2]
                nearest = np.minimum(nearest, x * x + y * y + z * z)  # keeps NaN, unlike min
            least = np.minimum(least, np.sqrt(nearest) - sizes[o, b])
    return least
