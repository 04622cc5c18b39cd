"""Work of a backup trajectory between two decisions: near pairs, ramps of velocities, distances of paths."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rows import distance_rows
from qpavoid.problem import Array, IntArray, Mask

ROUND_OFF = 1e-12
"""Difference of velocities that counts as none [rad/s, m/s]."""


@compiled
def backup_rows(
    x: Any, q: Array, pairs: IntArray, reach: float, moving: bool, enabled: Mask, touch: float
) -> tuple[int, int, float, float]:
    """Write velocity bounds, and the rows of the enabled pairs that are near and do not touch.

    Args:
        x: see `velocity_bounds` and `distance_rows`.
        q: configuration (nq,).
        pairs: which pairs to consider (c,), increasing.
        reach: distance below which a pair is near [m].
        moving: whether any obstacle moves.
        enabled: (m,) enabled pairs; those that touch are taken out.
        touch: distance below which a pair touches [m].

    Returns:
        Number of rows, number of enabled pairs that touch, and the least distance with these and without [m];
        `reach`, where nothing is nearer.
    """
    velocity_bounds(x, q)
    k = distance_rows(x, pairs, reach, moving)
    n, touching, nearest, rest = 0, 0, reach, reach
    for i in range(k):
        if not enabled[x.near[i]]:
            continue
        distance, slack = x.closest[i, 0], x.distance_allowance[x.near[i]]
        nearest = np.minimum(nearest, distance + slack)  # keeps NaN, unlike min
        if not distance >= touch:
            enabled[x.near[i]] = False
            touching += 1
            continue
        rest = min(rest, distance + slack)
        if n < i:
            x.near[n], x.feedforward[n] = x.near[i], x.feedforward[i]
            for c in range(10):
                x.closest[n, c] = x.closest[i, c]
            for c in range(x.J.shape[1]):
                x.J[n, c] = x.J[i, c]
        n += 1
    return n, touching, nearest, rest


@compiled
def closes_below(closest: Array, J: Array, feedforward: Array, v: Array, span: float, safe: float) -> bool:
    """Return True if a pair is nearer than `safe` after `span`, to first order.

    Args:
        closest: distances first (k, 10) [m].
        J: velocity Jacobian of these (k, n).
        feedforward: their rates due to the obstacles (k,) [m/s].
        v: velocity (n,).
        span: [s].
        safe: [m].
    """
    for i in range(len(feedforward)):
        rate = feedforward[i]
        for c in range(len(v)):
            rate += J[i, c] * v[c]
        if closest[i, 0] + span * rate < safe:
            return True
    return False


@compiled
def rate_limit(v: Array, wanted: Array, v_step: Array, meets: bool) -> Array:
    """Compute velocities of successive ticks, each as close to the wanted one as the largest changes allow.

    Args:
        v: velocity (n,) before.
        wanted: velocities (k, n).
        v_step: largest change of v in a tick (n,), infinite where there is none.
        meets: whether to end where the wanted velocity is met.

    Returns:
        As many as there are until then (<= k, n).
    """
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
def min_sphere_distance(paths: Array, centers: Array, sizes: Array) -> float:
    """Compute the least distance between spheres that move along paths and others at rest [m]; infinite without any.

    Args:
        paths: centres at some times (t, o, 3) [m].
        centers: of those at rest (b, 3) [m].
        sizes: sum of the radii of each combination (o, b) [m].
    """
    least = np.inf
    for o in range(paths.shape[1]):
        for b in range(len(centers)):
            nearest = np.inf
            for t in range(len(paths)):
                x, y, z = paths[t, o, 0] - centers[b, 0], paths[t, o, 1] - centers[b, 1], paths[t, o, 2] - centers[b, 2]
                nearest = np.minimum(nearest, x * x + y * y + z * z)  # keeps NaN, unlike min
            least = np.minimum(least, np.sqrt(nearest) - sizes[o, b])
    return least
