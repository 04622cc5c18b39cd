"""Near pairs along a rollout: a distance is computed anew once its bodies have gone far enough for it to matter.

No distance changes by more than its two bodies travel. So a pair that was d apart is beyond the influence distance for
certain until their travels add up to the difference. And one that is certainly beyond the preferred distance keeps its
witness points, as points fixed to the bodies, until the travels add up to a fraction of d: rows of the policy take the
distance of these points, which is an upper bound; clearances take the lower one, d less the travels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.kernels.broadphase import candidates
from qpavoid.kernels.distances import SPARE_BY_COAL, TO_HALF_SPACE, compute_distances
from qpavoid.kernels.packing import compiled, inlined
from qpavoid.problem import Array, IntArray

_TRAVEL_FRACTION = 0.1
"""Travels, over the distance, up to which a pair keeps its witness points [-]: the normal turns by no more than that.
With 0.25, a bar between two balls is led 25 mm nearer to them than with 0.1, which is as with exact distances."""


class PairMemory(NamedTuple):
    """What a rollout knows of the m pairs among g bodies."""

    radius: Array
    """(g,) of the bounding sphere of each body [m]."""
    centers: Array
    """(g, 3) of the bounding spheres, at the last pose [m]."""
    rotations: Array
    """(g, 9) of the bodies at the last pose, by columns."""
    travels: Array
    """(g,) bound on the path that any point of each body has travelled [m]."""
    computed: Array
    """(m,) distance of each pair when it was computed, less its margin [m]."""
    limits: Array
    """(m,) the same plus the travels of its bodies until then, less which it bounds the distance; -∞ at first [m]."""
    bounds: Array
    """(m,) lower bound on the distance of each pair that was not computed at the last pose, infinite of others [m]."""
    points: Array
    """(m, 6) witness points of each pair, each in the frame of its body; the second is moved towards the first by the
    margin, as if its body were so much larger [m]."""
    due: IntArray
    """(m,) the first entries: pairs that are computed at this pose."""


@compiled
def forget_pairs(p: PairMemory) -> None:
    """Begin a rollout, of which nothing is known."""
    p.travels[:], p.limits[:], p.bounds[:] = 0.0, -np.inf, np.inf


@compiled
def near_pairs_along(
    x: Any, p: PairMemory, moved: IntArray, is_first: bool, influence_distance: float, preferred_distance: float
) -> tuple[int, int, int]:
    """Find the near pairs of a pose, and write their results, see `near_pairs`.

    Args:
        x: `DistanceArrays`; the poses of all bodies are written.
        p: memory of the rollout.
        moved: numbers of the obstacles that may have moved (k,).
        is_first: whether this is the first pose.
        influence_distance: distance below which a pair gets a row [m].
        preferred_distance: distance below which a pair is computed at every pose [m].

    Returns:
        Number of near pairs, of rows, and of pairs that coal has to compute.
    """
    bodies = len(x.joints)
    while bodies > 0 and x.joints[bodies - 1] < 0:
        bodies -= 1
    near = candidates(x.poses, x.local, x.centers, x.max_square[:bodies], x.pair_of[:bodies], x.enabled, x.near)
    for g in range(len(x.joints)):
        if x.joints[g] >= 0:
            _add_travel(x, p, g, is_first)
    for i in moved:
        for g in range(x.first[i], x.first[i + 1]):
            _add_travel(x, p, g, is_first)
    due, rows, count, poses, results, limits, travels = 0, 0, 0, x.poses, x.results, p.limits, p.travels
    for n in range(near):
        k = x.near[n]
        a, b, bound = x.pairs[k, 0], x.pairs[k, 1], -np.inf
        if x.method[k] != TO_HALF_SPACE:  # whose travels may be endless
            bound = limits[k] - travels[a] - travels[b]
        if bound >= influence_distance:
            continue
        if bound >= preferred_distance and p.computed[k] - bound <= _TRAVEL_FRACTION * p.computed[k]:
            margin = x.margin[x.twist_row[k]]
            p.bounds[k] = bound + margin
            _follow_points(poses[a], poses[b], p.points[k], margin, results[k])
        else:
            p.bounds[k] = np.inf
            p.due[due] = k
            due += 1
        x.near[count] = k
        count += 1
        if not x.ignored[k]:
            x.rows[rows] = k
            rows += 1
    meeting = compute_distances(x.shapes, x.poses, x.pairs, x.method, p.due[:due], x.guesses, x.results, x.meeting)
    for k in p.due[:due]:
        _remember(x, p, k)
    for k in x.meeting[:meeting]:
        p.limits[k] = -np.inf
    x.counts[0], x.counts[1], x.counts[2] = count, rows, meeting
    return count, rows, meeting


@inlined
def _add_travel(x: Any, p: PairMemory, g: int, is_first: bool) -> None:
    """Add to the travel of a body what no point of it exceeds: with ‖δR‖ r for points at r from the centre."""
    square, turned = 0.0, 0.0
    for c in range(3):
        square += (x.centers[g, c] - p.centers[g, c]) ** 2
        p.centers[g, c] = x.centers[g, c]
    for c in range(9):
        turned += (x.poses[g, c] - p.rotations[g, c]) ** 2
        p.rotations[g, c] = x.poses[g, c]
    if not is_first:
        p.travels[g] += np.sqrt(square)
        if turned > 0.0:
            p.travels[g] += np.sqrt(0.5 * turned) * p.radius[g]  # of a rotation, the Frobenius norm is √2 times ‖δR‖


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
    p.limits[k] = p.computed[k] + p.travels[a] + p.travels[b]
    for c in range(3):
        p.points[k, c], p.points[k, 3 + c] = 0.0, 0.0
        for r in range(3):
            p.points[k, c] += x.poses[a, 3 * c + r] * (result[4 + r] - x.poses[a, 9 + r])
            second = result[7 + r] - margin * result[1 + r]
            p.points[k, 3 + c] += x.poses[b, 3 * c + r] * (second - x.poses[b, 9 + r])
