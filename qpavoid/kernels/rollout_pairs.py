"""Near pairs along a rollout: a distance is computed anew once its bodies have gone far enough for it to matter.

No distance changes by more than its two bodies travel. So a pair that was d apart is beyond the influence distance for
certain until their travels add up to the difference. And one that is certainly beyond the preferred distance keeps its
witness points, as points fixed to the bodies, until the travels add up to a fraction of d: rows of the policy take the
distance of these points, which is an upper bound; clearances take the lower one, d less the travels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.distances import SPARE_BY_COAL
from qpavoid.kernels.near_pairs import candidate_pairs, least_distance, measure_pairs
from qpavoid.kernels.packing import compiled, inlined
from qpavoid.problem import Array, IntArray

_TRAVEL_FRACTION = 0.1
"""Travels, over the distance, up to which a pair keeps its witness points [-]: the normal turns by no more than that.
With 0.25, a bar between two balls is led 25 mm nearer to them than with 0.1, which is as with exact distances."""


class PairMemory(NamedTuple):
    """What a rollout knows of the m pairs."""

    computed: Array
    """(m,) distance of each pair when it was computed, less its margin [m]."""
    bounds: Array
    """(m,) lower bound on the distance of each pair that was not computed at the last pose, infinite of others [m]."""
    points: Array
    """(m, 6) witness points of each pair, each in the frame of its body; the second is moved towards the first by the
    margin, as if its body were so much larger [m]."""
    due: IntArray
    """(m,) the first entries: pairs that are computed at this pose."""


@compiled
def forget_pairs(x: Any, p: PairMemory) -> None:
    """Begin a rollout, of which nothing is known."""
    x.limits[:], p.bounds[:] = -np.inf, np.inf


@compiled
def near_pairs_along(
    x: Any, p: PairMemory, influence_distance: float, preferred_distance: float
) -> tuple[int, int, int]:
    """Find the near pairs of a pose, and write their results, see `near_pairs`.

    Args:
        x: `DistanceArrays`; the poses of all bodies are written.
        p: memory of the rollout.
        influence_distance: distance below which a pair gets a row [m].
        preferred_distance: distance below which a pair is computed at every pose [m].

    Returns:
        Number of near pairs, of rows, and of pairs that coal has to compute.
    """
    near = candidate_pairs(x)
    due, rows, count, poses, results = 0, 0, 0, x.poses, x.results
    for n in range(near):
        k = x.near[n]
        margin = x.margin[x.twist_row[k]]
        bound = least_distance(x, k) - margin
        if bound >= influence_distance:
            continue
        if bound >= preferred_distance and p.computed[k] - bound <= _TRAVEL_FRACTION * p.computed[k]:
            p.bounds[k] = bound + margin
            _follow_points(poses[x.pairs[k, 0]], poses[x.pairs[k, 1]], p.points[k], margin, results[k])
        else:
            p.bounds[k] = np.inf
            p.due[due] = k
            due += 1
        x.near[count] = k
        count += 1
        if not x.ignored[k]:
            x.rows[rows] = k
            rows += 1
    meeting = measure_pairs(x, p.due[:due])
    for k in p.due[:due]:
        _remember(x, p, k)
    x.counts[0], x.counts[1], x.counts[2] = count, rows, meeting
    return count, rows, meeting


@inlined
def _follow_points(one: Array, two: Array, points: Array, margin: float, result: Array) -> None:
    """Write the result of a pair from `points` fixed to its bodies, which are at the poses `one` and `two`."""
    square = 0.0
    for r in range(3):
        a = one[9 + r] + one[r] * points[0] + one[3 + r] * points[1] + one[6 + r] * points[2]
        b = two[9 + r] + two[r] * points[3] + two[3 + r] * points[4] + two[6 + r] * points[5]
        result[1 + r], result[4 + r], result[7 + r] = b - a, a, b
        square += (b - a) ** 2
    distance = np.sqrt(square)
    for c in range(3):
        result[1 + c] /= distance
    result[0] = distance + margin


@inlined
def _remember(x: Any, p: PairMemory, k: int) -> None:
    """Keep the result of a pair that was computed, but for those that coal computes later."""
    a, b, result = x.pairs[k, 0], x.pairs[k, 1], x.results[k]
    if x.method[k] <= SPARE_BY_COAL:
        return
    margin = x.margin[x.twist_row[k]]
    p.computed[k] = result[0] - margin
    for c in range(3):
        p.points[k, c], p.points[k, 3 + c] = 0.0, 0.0
        for r in range(3):
            p.points[k, c] += x.poses[a, 3 * c + r] * (result[4 + r] - x.poses[a, 9 + r])
            second = result[7 + r] - margin * result[1 + r]
            p.points[k, 3 + c] += x.poses[b, 3 * c + r] * (second - x.poses[b, 9 + r])
