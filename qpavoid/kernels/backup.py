"""Kernels of backup trajectories: rows of near pairs, clearance of paths."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.bounds import velocity_bounds
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.rows import distance_rows
from qpavoid.problem import Array, IntArray, Mask


@compiled
def backup_rows(
    x: Any,
    q: Array,
    pairs: IntArray,
    bounds: Array,
    influence_distance: float,
    moving: bool,
    enabled: Mask,
    touch: float,
) -> tuple[int, int, float, float]:
    """Write velocity bounds, and the rows of the enabled pairs that are near and not in contact, less their margins.

    Args:
        x: see `velocity_bounds` and `distance_rows`.
        q: configuration (nq,).
        pairs: which pairs to consider (c,), increasing.
        bounds: lower bound on the distance of each pair whose result is larger than that, infinite of others (m,) [m].
        influence_distance: distance below which a pair is near [m].
        moving: whether any obstacle moves.
        enabled: (m,) enabled pairs; those in contact are disabled.
        touch: distance below which a pair is in contact [m].

    Returns:
        Number of rows, number of enabled pairs in contact, and the least distance with these and without [m], at most
        `influence_distance`.
    """
    velocity_bounds(x, q)
    k = distance_rows(x, pairs, influence_distance, moving)
    n, touching, nearest, nearest_separable = 0, 0, influence_distance, influence_distance
    for i in range(k):
        pair = x.near_pairs[i]
        if not enabled[pair]:
            continue
        margin, slack = x.margin[x.twist_row[pair]], x.distance_allowance[pair]
        distance = np.minimum(x.closest[i, 0], bounds[pair]) - margin  # keeps NaN, unlike min
        x.closest[i, 0] -= margin
        nearest = np.minimum(nearest, distance + slack)
        if not distance >= touch:
            enabled[pair] = False
            touching += 1
            continue
        nearest_separable = min(nearest_separable, distance + slack)
        if n < i:
            x.near_pairs[n], x.feedforward[n] = x.near_pairs[i], x.feedforward[i]
            for c in range(10):
                x.closest[n, c] = x.closest[i, c]
            for c in range(x.J.shape[1]):
                x.J[n, c] = x.J[i, c]
        n += 1
    return n, touching, nearest, nearest_separable


@compiled
def closes_below(closest: Array, J: Array, feedforward: Array, v: Array, span: float, distance: float) -> bool:
    """Return whether a pair is nearer than `distance` after `span`, to first order.

    Args:
        closest: distances first (k, 10) [m].
        J: velocity Jacobian of these (k, n).
        feedforward: their rates due to the obstacles (k,) [m/s].
        v: velocity (n,).
        span: time [s].
        distance: threshold [m].
    """
    for i in range(len(feedforward)):
        rate = feedforward[i]
        for c in range(len(v)):
            rate += J[i, c] * v[c]
        if closest[i, 0] + span * rate < distance:
            return True
    return False


@compiled
def max_offset(offset: Array, ramp: Array, targets: Array, dt: float) -> float:
    """Compute the largest sum over the joints of how far they are from a trajectory, on the way back to it [rad, m].

    Args:
        offset: of the configuration now (n,) [rad or m].
        ramp: velocities (k, n) of successive control steps.
        targets: velocities (>= k, n) of the trajectory.
        dt: control period [s].
    """
    sums, largest = offset.copy(), np.sum(np.abs(offset))
    for i in range(len(ramp)):
        total = 0.0
        for j in range(len(sums)):
            sums[j] += dt * (ramp[i, j] - targets[i, j])
            total += abs(sums[j])
        largest = max(largest, total)
    return largest
